"""A webcam's graph whose reader and solver are planted."""

import pytest
import torch
from torch import Tensor, nn

from torchface.landmarks import FaceReading
from torchface.landmarks.images.frame_reader.face_reader import STATE
from torchface.landmarks.images.frame_reader.picture_pieces import picture_size
from torchface.onnx.webcam.webcam_model import WebcamAnswer, WebcamGraph, reading_model, solving_model, webcam_model
from torchface.shape_names import ARKIT


class PlantedReader(nn.Module):
    """Sees a face over the whole picture, as sure as the picture's first pixel is red, and counts frames."""

    def forward(self, image: Tensor, interval: Tensor, state: Tensor) -> tuple[FaceReading, Tensor]:
        marks = torch.linspace(0, 1, 136).view(68, 2) * picture_size(image)
        sure, both = torch.ones(68), torch.ones(2)
        presence = image[0, 0, 0].float() / 255
        after = torch.cat([state[:3] + 1, torch.zeros(STATE - 3)])
        return FaceReading(marks, sure, sure, presence, marks[::67], both, both, both), after


class PlantedSolver(nn.Module):
    """Counts frames and gives the first weight what the landmarks' mean column is."""

    state_size = 2

    def forward(self, *given: Tensor) -> WebcamAnswer:
        landmarks, (size, interval, controls, state) = given[0], given[-4:]
        weights = torch.cat([landmarks[:, 0].mean()[None], torch.zeros(len(ARKIT) - 1)])
        gaze = torch.stack([size, size])
        return WebcamAnswer(weights, torch.eye(3), controls[:3], gaze, interval, interval, interval, state + 1)


@pytest.fixture(scope="session")
def solver() -> PlantedSolver:
    return PlantedSolver()


@pytest.fixture(scope="session")
def webcam_module(solver: PlantedSolver) -> WebcamGraph:
    """What the graph computes, in PyTorch."""
    return WebcamGraph(PlantedReader(), solver)


@pytest.fixture(scope="session")
def webcam_file(solver: PlantedSolver) -> bytes:
    """The graph."""
    reading = reading_model(PlantedReader(), solver.state_size)
    return webcam_model(reading, solving_model(solver), {"licence": "MIT"}).SerializeToString()
