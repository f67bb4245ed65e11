# SPDX-License-Identifier: Apache-2.0
"""The error family: every message names the file, topic, camera or field and the value that was found.

What pydantic finds wrong is worded here too: one line that names the field and the value.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError


class CvcDepthError(Exception):
    """Base class: something is wrong with the input. Programs print the message as one line and exit."""


class ConfigError(CvcDepthError):
    """A configuration file or parameter has an unknown field, a wrong type or a value out of range."""


class RigError(CvcDepthError):
    """A camera's calibration, transform or mask is missing, impossible or contradicts another."""


class ImageError(CvcDepthError):
    """An image cannot be decoded, or is not of the size or encoding that was announced."""


class CheckpointError(CvcDepthError):
    """A checkpoint is missing, damaged, or does not fit the network."""


class EngineError(CvcDepthError):
    """An inference engine is not installed, gives another depth than the network, or is out of memory."""


class TrainingError(CvcDepthError):
    """A training cannot go on."""


class NotPromotedError(TrainingError):
    """A training ended as it should, but its weights did not prove to be better than those it started from."""


class OutputError(CvcDepthError):
    """A result cannot be written: the disk is full, or the folder is missing or write-protected."""


class RecordingError(CvcDepthError):
    """A recording cannot be read, or lacks what the command needs."""


class TransformError(RigError):
    """No transform leads from one frame to another."""


def first_validation_message(error: ValueError) -> str:
    """Return one line on the first field that is wrong: `field: what is wrong, found value`.

    Errors that are not pydantic's say what they say.
    """
    details = getattr(error, "errors", None)
    if details is None:
        return str(error)
    first = details()[0]
    where, message = _place(first), _message(first)
    if not where:
        return message
    # Our own checks say the value themselves, and a missing field has none.
    says_all = first["type"] in ("missing", "value_error")
    return f"{where}: {message}" if says_all else f"{where}: {message}, found {_shortened(first['input'])}"


def validation_messages(error: ValidationError, model: type[BaseModel]) -> str:
    """Return one line on every field that is wrong: `field is value: what is wrong; ...`.

    A field that `model` does not know is named together with those that it knows there.
    """
    return "; ".join(_problem(item, model) for item in error.errors(include_url=False))


def _problem(item: Mapping[str, Any], model: type[BaseModel]) -> str:
    where = _place(item)
    if item["type"] == "extra_forbidden":
        return f"{where} is no known field; expected one of {', '.join(_known_fields(item['loc'], model))}"
    if item["type"] == "missing":
        return f"{where} is missing"
    return f"{where} is {_shortened(item['input'])}: {_message(item)}" if where else _message(item)


def _place(item: Mapping[str, Any]) -> str:
    return ".".join(map(str, item["loc"]))


def _message(item: Mapping[str, Any]) -> str:
    return str(item["msg"]).removeprefix("Value error, ")


def _shortened(value: object) -> str:
    # The whole of a foreign value may have no end: a few lines of YAML can refer to themselves a billion times.
    return f"{reprlib.repr(value):.80}"


def _known_fields(location: tuple[str | int, ...], model: type[BaseModel]) -> list[str]:
    section: Any = model
    for part in location[:-1]:
        section = section.model_fields[part].annotation
    return list(section.model_fields)
