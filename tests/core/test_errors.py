# SPDX-License-Identifier: Apache-2.0
"""What pydantic finds wrong is said in one line: the field, what is wrong, the value, and what would be right."""

import pytest
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from cvcdepth_core.errors import first_validation_message, validation_messages


class Lens(BaseModel):
    model_config = ConfigDict(extra="forbid")

    focal_length: float
    aperture: float = 2.0

    @model_validator(mode="after")
    def _check(self) -> "Lens":
        if self.aperture > self.focal_length:
            raise ValueError(f"aperture {self.aperture} is wider than the lens")
        return self


class Camera(BaseModel):
    model_config = ConfigDict(extra="forbid")

    lens: Lens
    pixels: int = 1


def error_of(content: object) -> ValidationError:
    with pytest.raises(ValidationError) as error:
        Camera.model_validate(content)
    return error.value


WRONG = {
    "type": (
        {"lens": {"focal_length": "long"}},
        "lens.focal_length: Input should be a valid number, unable to parse string as a number, found 'long'",
        "lens.focal_length is 'long': Input should be a valid number, unable to parse string as a number",
    ),
    "missing": ({"lens": {}}, "lens.focal_length: Field required", "lens.focal_length is missing"),
    "unknown": (
        {"lens": {"focal_length": 8, "zoom": 3}},
        "lens.zoom: Extra inputs are not permitted, found 3",
        "lens.zoom is no known field; expected one of focal_length, aperture",
    ),
    "contradiction": (
        {"lens": {"focal_length": 1}},
        "lens: aperture 2.0 is wider than the lens",
        "lens is {'focal_length': 1}: aperture 2.0 is wider than the lens",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_the_first_field_is_named_with_its_value_and_all_fields_with_what_is_known(case: str):
    content, first, every = WRONG[case]
    error = error_of(content)
    assert first_validation_message(error) == first
    assert validation_messages(error, Camera) == every


def test_of_several_mistakes_one_line_names_the_first_and_another_all():
    error = error_of({"lens": {"focal_length": 8, "zoom": 3}, "pixels": "many", "colour": 1})
    assert first_validation_message(error).startswith("lens.zoom: ")
    assert all(f"{field} is " in validation_messages(error, Camera) for field in ("lens.zoom", "pixels", "colour"))


def test_a_value_without_end_is_shortened():
    endless: list[object] = []
    endless.extend([endless] * 1000)
    for text in (first_validation_message(error_of({"lens": endless})), validation_messages(error_of(endless), Camera)):
        assert len(text) < 250


def test_an_error_that_is_not_pydantics_speaks_for_itself():
    assert first_validation_message(ValueError("no lens")) == "no lens"
