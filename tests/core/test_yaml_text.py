# SPDX-License-Identifier: Apache-2.0
"""YAML files give plain values, and one kind of error whatever is wrong with them."""

import pytest
import yaml

from cvcdepth_core.yaml_text import load_yaml


def test_entries_are_merged_as_yaml_says():
    text = "common: &common {fps: 10, mask: a.png}\n"
    text += "front: {<<: *common, mask: b.png}\nback: {<<: [*common, {fps: 5, k: 1}]}\n"
    content = load_yaml(text)
    assert content == yaml.safe_load(text)
    assert content["front"] == {"fps": 10, "mask": "b.png"}
    assert content["back"] == {"fps": 10, "mask": "a.png", "k": 1}


WRONG = {
    "no end": "a: [",
    "a function": "!!python/object/apply:os.system [true]",
    "a date that is none": "2001-99-99",
    "a time that is none": "!!timestamp soon",
    "a number without digits": "!!int ''",
    "nested without end": "[" * 100_000,
    "merged with itself": "&a {<<: *a}",
    "merged with a word": "{<<: word}",
    "half a million merged entries": "a0: &a0 {k: 1}\n"
    + "".join(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 9)}]}}\n" for n in range(1, 7)),
}


@pytest.mark.parametrize("case", WRONG)
def test_whatever_is_wrong_with_yaml_is_one_kind_of_error(case: str):
    with pytest.raises(yaml.YAMLError, match=r"."):
        load_yaml(WRONG[case])
