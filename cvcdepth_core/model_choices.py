# SPDX-License-Identifier: Apache-2.0
"""The model that comes with the package, so that depth can be seen before anybody has trained."""

from pathlib import Path

DEFAULT = "default"
"""What may stand for the model's path."""

NOTICE = (
    "default model: trained on three seconds of one street, to try the software and to start training from, not for "
    "driving"
)

_PATH = Path(__file__).parent / "models" / "default.safetensors"


def checkpoint_path(name: str) -> Path:
    """Return the file that `name` stands for; nothing and 'default' stand for the model that comes with the package."""
    return _PATH if name in ("", DEFAULT) else Path(name).expanduser()
