# SPDX-License-Identifier: Apache-2.0
"""The node's parameters, declared and read: `NodeParameters` gives defaults, descriptions, ranges and checks."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, Literal, get_args, get_origin

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from cvcdepth_core.errors import ConfigError, first_validation_message
from cvcdepth_ros.settings import NodeParameters

_QOS_PREFIX = "qos_overrides."


def declare_parameters(node: Node) -> None:
    """Declare every parameter with its description and range."""
    for name, field in NodeParameters.model_fields.items():
        node.declare_parameter(name, field.default, _descriptor(name, field))


def read_parameters(node: Node, changed: Iterable[Any] = ()) -> NodeParameters:
    """Read and check the parameters as they stand, with `changed` (rclpy Parameters) in place of their old values.

    ConfigError names the parameter and the value.
    """
    values = {name: node.get_parameter(name).value for name in NodeParameters.model_fields}
    values |= {parameter.name: parameter.value for parameter in changed if parameter.name in values}
    try:
        return NodeParameters.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"parameter {first_validation_message(error)}") from error


def unknown_parameters(node: Node) -> list[str]:
    """Return a line for each value that was given, on the command line or in a file, to a parameter that is none.

    Overrides of QoS are left out: their parameters are declared with their topics (`unknown_qos_overrides`).
    """
    given = [name for name in _overrides(node) if not name.startswith(_QOS_PREFIX)]
    known = [*NodeParameters.model_fields, "use_sim_time"]
    return [_unknown(name, known) for name in given if not node.has_parameter(name)]


def unknown_qos_overrides(node: Node, expected_topics: Collection[str]) -> list[str]:
    """Return a line for each override of QoS for a topic that the node neither has nor expects (full names)."""
    declared = node.get_parameters_by_prefix(_QOS_PREFIX.rstrip("."))
    topics = {name.split(".")[0] for name in declared} | set(expected_topics)
    given = [name for name in _overrides(node) if name.startswith(_QOS_PREFIX) and not node.has_parameter(name)]
    by_topic = {name: name.removeprefix(_QOS_PREFIX).split(".")[0] for name in given}
    return [_unknown(name, sorted(topics), topic) for name, topic in by_topic.items() if topic not in topics]


def _overrides(node: Node) -> Collection[str]:
    """Return the names of the values that were given; rclpy has no public way to them."""
    overrides: Mapping[str, Any] = getattr(node, "_parameter_overrides", {})
    return overrides.keys()


def _unknown(name: str, known: Sequence[str], part: str = "") -> str:
    """Say that a parameter is none, with the known name that is nearest to it, or to a part of it."""
    nearest = get_close_matches(part or name, known, n=1)
    hint = f"; did you mean {name.replace(part or name, nearest[0])}?" if nearest else ""
    return f"parameter {name} is unknown and has no effect{hint}"


def _descriptor(name: str, field: FieldInfo) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(name=name, description=field.description or "")
    low, high = _limit(field, "ge", "gt"), _limit(field, "le")
    if low is not None and field.annotation is int:
        step = _limit(field, "multiple_of") or 0
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=step)]
    elif low is not None:
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    if get_origin(field.annotation) is Literal:
        descriptor.additional_constraints = f"one of {', '.join(get_args(field.annotation))}"
    return descriptor


def _limit(field: FieldInfo, *kinds: str) -> Any:
    """Return the field's constraint of one of these kinds; None where it has none."""
    found = [getattr(constraint, kind, None) for constraint in field.metadata for kind in kinds]
    return next((value for value in found if value is not None), None)
