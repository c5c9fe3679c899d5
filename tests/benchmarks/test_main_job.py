"""The main job on a real rig and six real takes: transfer to a random head, film, solve, compare with the truth."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchface.workflows.demo import DemoResult, embedded_scene, run_demo, scene_from

HEADING = ("take", "frames", "weight error", "correlation", "marker RMSE mm", "mesh error mm", "of the motion")


def row(name: str, result: DemoResult) -> tuple[str, ...]:
    correlation = result.weight_error.correlation
    return (
        name,
        str(len(result.weights)),
        f"{float(result.weight_error.mean.mean()):.4f}",
        f"{float(correlation[torch.isfinite(correlation)].median()):.3f}",
        f"{float(result.marker_rmse.nanmedian()):.3f}",
        f"{result.mesh_error.mean:.3f}",
        f"{100 * result.mesh_error.relative:.1f} %",
    )


def show(rows: list[tuple[str, ...]]) -> None:
    for cells in (HEADING, *rows):
        print("| " + " | ".join(cells) + " |")


@pytest.mark.real
def test_real_rig_and_takes(ict_folder: Path, performances: list[Path], tmp_path: Path) -> None:
    rows = []
    for path in performances:
        result = run_demo(scene_from(ict_folder, path, None, seed=1), tmp_path, seed=1)
        rows.append(row(path.stem, result))
        assert result.mesh_error.mean < 0.5
    print("\nICT-FaceKit, random head 1, 100 markers, 0.3 mm noise, 2 % of the samples and short gaps missing")
    show(rows)


def test_embedded_performer(tmp_path: Path) -> None:
    rows = []
    for seed in (1, 2, 3):
        result = run_demo(embedded_scene(seed), tmp_path, seed=seed)
        rows.append(row(f"performer {seed}", result))
        assert result.mesh_error.mean < 0.5
    print("\nThe embedded performer, three random heads, made-up performances")
    show(rows)
