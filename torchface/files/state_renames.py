"""Names that parts of saved states and configs once had: models saved under them still load."""

from collections.abc import Collection, Mapping
from typing import Any

_SHAPE_PRIOR = {"freedom": "degrees_of_freedom"}
_DYNAMICS_PRIOR = {
    "trust": "gain",
    "processes.spread": "processes.covariance_root",
    "noise.rest": "noise.rest_variance",
    "noise.own": "noise.own_coefficients",
    "noise.shared": "noise.group_coefficients",
    "noise.together": "noise.group_average",
}
STATE_RENAMES: Mapping[str, Mapping[str, str]] = {
    "action_units": {"machine.for_first": "machine.first_class", "machine.for_second": "machine.second_class"},
    "dynamics_prior": _DYNAMICS_PRIOR,
    "reciprocal_prior": _SHAPE_PRIOR,
    "shape_prior": _SHAPE_PRIOR,
    "uv_landmarks": {"courses": "line_statistics", "looks": "line_profiles", "looseness": "corner_deviation"},
    "video_solver": {**_SHAPE_PRIOR, **_DYNAMICS_PRIOR},
}
"""For each kind of model: a state key's last parts as they were, and as they are now."""

CONFIG_RENAMES: Mapping[str, Mapping[str, str]] = {"action_units": {"beside": "other_units"}}
"""For each kind of model: a config key as it was, at any depth, and as it is now."""


def current_state_keys(kind: str, stored: Collection[str], expected: Collection[str]) -> dict[str, str]:
    """What the keys of a stored state are called now: a name for each of ``stored``, all different.

    A key is renamed only where the module lacks it, has the new one, and the state does not hold that one besides;
    what is left over is for the reader to refuse.
    """
    names = {key: key for key in stored}
    for key in stored:
        for old, new in STATE_RENAMES.get(kind, {}).items():
            renamed = key.removesuffix(old) + new
            whole = key == old or key.endswith(f".{old}")
            if whole and key not in expected and renamed in expected and renamed not in names.values():
                names[key] = renamed
    return names


def current_config(kind: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """A config under the names of today, nested tables and lists included; a key that is there under both stays."""
    renames = CONFIG_RENAMES.get(kind, {})

    def renamed(value: Any) -> Any:
        if isinstance(value, Mapping):
            names = {key: renames.get(key, key) for key in value}
            return {key if names[key] in value else names[key]: renamed(inner) for key, inner in value.items()}
        return [renamed(inner) for inner in value] if isinstance(value, list) else value

    return dict(renamed(config))
