# SPDX-License-Identifier: Apache-2.0
"""The errors of the family: every message names the file, topic, camera or field and the value that was found."""


class CvcDepthError(Exception):
    """Anything that is wrong with what came in. Programs print its message as one line and exit."""


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
    """A result cannot be written: the disk is full, the folder is not there or not ours."""


class RecordingError(CvcDepthError):
    """A recording cannot be read, or lacks what the command needs."""


class TransformError(RigError):
    """No transform leads from one frame to another."""
