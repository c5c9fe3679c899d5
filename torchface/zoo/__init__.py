"""Learned models by name: those that come with torchface, the user's own in ``$TORCHFACE_HOME`` or any folder."""

from torchface.files.models import STATE
from torchface.zoo.kinds import KINDS, register
from torchface.zoo.loading import ModelDescription, describe, get_model, verify
from torchface.zoo.model_folders import HOME, damaged_models, find, list_models
from torchface.zoo.saving import ModelCard, save_model

__all__ = [
    "HOME",
    "KINDS",
    "STATE",
    "ModelCard",
    "ModelDescription",
    "damaged_models",
    "describe",
    "find",
    "get_model",
    "list_models",
    "register",
    "save_model",
    "verify",
]
