# SPDX-License-Identifier: Apache-2.0
"""Checkpoints come back as they were, and whatever does not fit is refused by name."""

import hashlib
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from cvcdepth_core.errors import CheckpointError, OutputError
from cvcdepth_core.networks import DepthNet, PoseNet
from cvcdepth_core.networks.checkpoint import (
    check_sha256,
    import_released,
    is_pickle,
    load_checkpoint,
    load_imagenet_encoder,
    load_network_state,
    load_spec,
    save_checkpoint,
)
from cvcdepth_core.networks.registry import DepthModelSpec

SPEC = DepthModelSpec(height=384, width=640, min_depth=1.5, max_depth=200)


@pytest.fixture(scope="module")
def depth_net():
    return DepthNet().eval()


@pytest.fixture(scope="module")
def pose_net():
    return PoseNet().eval()


@pytest.fixture
def checkpoint(tmp_path, depth_net, pose_net):
    path = tmp_path / "net.safetensors"
    save_checkpoint(path, SPEC, depth_net.state_dict(), pose_net.state_dict(), {"command": "finetune"})
    return path


def test_a_checkpoint_comes_back_as_it_was_written(checkpoint, depth_net, pose_net):
    loaded = load_checkpoint(checkpoint)
    assert (loaded.spec, loaded.metadata, loaded.path) == (SPEC, {"command": "finetune"}, checkpoint)
    assert loaded.sha256 == hashlib.sha256(checkpoint.read_bytes()).hexdigest()
    image = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(loaded.build_depth_net().disparity(image), depth_net.disparity(image), rtol=0, atol=0)
    assert all(torch.equal(value, loaded.pose_net[key]) for key, value in pose_net.state_dict().items())
    assert [path.name for path in checkpoint.parent.iterdir()] == [checkpoint.name]


def test_half_precision_weights_are_widened(tmp_path, depth_net):
    half = {key: value.half() if value.is_floating_point() else value for key, value in depth_net.state_dict().items()}
    save_checkpoint(tmp_path / "half.safetensors", SPEC, half)
    loaded = load_checkpoint(tmp_path / "half.safetensors")
    assert {value.dtype for value in loaded.build_depth_net().parameters()} == {torch.float32}
    assert loaded.pose_net == {}


def test_a_failed_write_leaves_the_old_checkpoint_and_no_litter(checkpoint, depth_net, monkeypatch):
    before = checkpoint.read_bytes()

    def full_disk(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OutputError, match=r"net.safetensors: cannot be written: .*No space"):
        save_checkpoint(checkpoint, SPEC, depth_net.state_dict())
    assert checkpoint.read_bytes() == before
    assert [path.name for path in checkpoint.parent.iterdir()] == [checkpoint.name]


def test_reserved_metadata_keys_are_refused(tmp_path, depth_net):
    with pytest.raises(CheckpointError, match="cvcdepth_spec"):
        save_checkpoint(tmp_path / "x", SPEC, depth_net.state_dict(), metadata={"cvcdepth_spec": ""})


def write_cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def write_pickle(path: Path) -> None:
    torch.save({"a": torch.zeros(1)}, path)


def write_old_pickle(path: Path) -> None:
    path.write_bytes(pickle.dumps({"a": 1}, protocol=4))


def write_foreign(path: Path) -> None:
    save_file({"a": torch.zeros(1)}, path)


def write_later_version(path: Path) -> None:
    save_file({"a": torch.zeros(1)}, path, {"cvcdepth_format_version": "2"})


def write_without_spec(path: Path) -> None:
    save_file({"a": torch.zeros(1)}, path, {"cvcdepth_format_version": "1"})


def write_unknown_encoder(path: Path) -> None:
    spec = SPEC.model_dump_json().replace("resnet18", "resnet99")
    save_file({"a": torch.zeros(1)}, path, {"cvcdepth_format_version": "1", "cvcdepth_spec": spec})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (Path.unlink, "no such file"),
        (write_cut, "damaged"),
        (lambda path: path.write_bytes(b""), "damaged"),
        (write_pickle, "is a pickle"),
        (write_old_pickle, "is a pickle"),
        (write_foreign, "format version is None"),
        (write_later_version, "format version is '2'"),
        (write_without_spec, "no model spec"),
        (write_unknown_encoder, "resnet99.*resnet18.*resnet34"),
    ],
)
def test_a_file_that_is_no_checkpoint_is_refused_by_name(checkpoint, damage, message):
    damage(checkpoint)
    with pytest.raises(CheckpointError, match=rf"{checkpoint}.*{message}") as told:
        load_checkpoint(checkpoint)
    with pytest.raises(CheckpointError) as also_told:
        load_spec(checkpoint)
    assert str(also_told.value) == str(told.value)


def test_no_length_of_a_header_makes_a_checkpoint_a_pickle(tmp_path):
    """The header's length comes first, in whole eights: 0x80 is where a pickle begins."""
    path, begins = tmp_path / "model.safetensors", set()
    for length in range(0, 256, 8):
        save_file({"weight": torch.zeros(1)}, path, metadata={"text": "-" * length})
        begins.add(path.read_bytes()[0])
        assert not is_pickle(path)
    assert 0x80 in begins


def test_what_it_is_for_can_be_read_alone(checkpoint):
    assert load_spec(checkpoint) == load_checkpoint(checkpoint).spec


def test_a_checkpoint_of_another_architecture_names_the_first_keys_and_their_count(tmp_path, depth_net):
    path = tmp_path / "net.safetensors"
    save_checkpoint(path, SPEC.model_copy(update={"encoder": "resnet34"}), depth_net.state_dict())
    with pytest.raises(CheckpointError, match=rf"{path}.*missing depth_encoder.encoder.layer1.2.*\(96 in all\)"):
        load_checkpoint(path).build_depth_net()


def test_missing_unexpected_misshapen_and_non_finite_entries_are_all_named(depth_net):
    state = dict(depth_net.state_dict())
    state["extra.weight"] = state.pop("depth_decoder.decoder.10.conv.bias")
    state["depth_decoder.decoder.10.conv.weight"] = torch.zeros(2, 16, 3, 3)
    state["depth_decoder.decoder.9.conv.conv.bias"] = torch.full((16,), torch.nan)
    with pytest.raises(CheckpointError) as error:
        load_network_state(DepthNet(), state, origin="here")
    assert str(error.value) == (
        "here: missing depth_decoder.decoder.10.conv.bias; unexpected extra.weight; "
        "misshapen depth_decoder.decoder.10.conv.weight is [2, 16, 3, 3], expected [1, 16, 3, 3]; "
        "not finite depth_decoder.decoder.9.conv.conv.bias"
    )


@pytest.fixture
def released(tmp_path, depth_net, pose_net):
    directory = tmp_path / "weights_19"
    directory.mkdir()
    for name, network in (("depth_net", depth_net), ("pose_net", pose_net)):
        state = {f"module.{key}": value for key, value in network.state_dict().items()}
        torch.save(state, directory / f"{name}.pth")
    return directory


def test_released_weights_are_imported_and_can_be_saved_as_a_checkpoint(released, depth_net, tmp_path):
    imported = import_released(released, SPEC)
    save_checkpoint(tmp_path / "imported.safetensors", SPEC, imported.depth_net, imported.pose_net)
    image = torch.rand(1, 3, 64, 64)
    network = load_checkpoint(tmp_path / "imported.safetensors").build_depth_net()
    torch.testing.assert_close(network.disparity(image), depth_net.disparity(image), rtol=0, atol=0)
    PoseNet().load_state_dict(imported.pose_net)


def test_released_weights_of_another_architecture_are_refused(released):
    with pytest.raises(CheckpointError, match=r"weights_19.*missing depth_encoder"):
        import_released(released, SPEC.model_copy(update={"encoder": "resnet34"}))


class Malicious:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (print, ("executed",))


@pytest.mark.parametrize("content", [{"module.a": Malicious()}, [torch.zeros(1)], {"module.a": 3}])
def test_a_released_file_with_more_than_tensors_is_refused_and_never_executed(released, content, capsys):
    torch.save(content, released / "pose_net.pth")
    with pytest.raises(CheckpointError, match=r"pose_net.pth"):
        import_released(released, SPEC)
    assert "executed" not in capsys.readouterr().out


def test_a_cut_or_missing_released_file_is_named(released):
    write_cut(released / "depth_net.pth")
    with pytest.raises(CheckpointError, match=r"depth_net.pth: is damaged"):
        import_released(released, SPEC)
    (released / "pose_net.pth").unlink()
    with pytest.raises(CheckpointError, match=r"pose_net.pth: no such file"):
        import_released(released, SPEC)


@pytest.fixture
def imagenet_file(tmp_path, depth_net):
    state = {
        key: value for key, value in depth_net.depth_encoder.encoder.state_dict().items() if "num_batches" not in key
    }
    torch.save({**state, "fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}, tmp_path / "resnet18.pth")
    return tmp_path / "resnet18.pth"


def test_imagenet_weights_start_both_encoders_and_two_equal_images_look_like_one(imagenet_file, depth_net):
    depth, pose = DepthNet().eval().depth_encoder, PoseNet().eval().pose_encoder
    load_imagenet_encoder(depth, imagenet_file)
    load_imagenet_encoder(pose, imagenet_file)
    image = torch.rand(1, 3, 64, 64)
    for ours, once, twice in zip(
        depth_net.depth_encoder(image), depth(image), pose(torch.cat([image, image], dim=1)), strict=True
    ):
        torch.testing.assert_close(once, ours)
        torch.testing.assert_close(twice, ours, rtol=1e-3, atol=1e-3)


def test_imagenet_weights_of_another_architecture_are_refused(imagenet_file):
    with pytest.raises(CheckpointError, match=r"resnet18.pth: ImageNet encoder: missing layer1.2"):
        load_imagenet_encoder(DepthNet("resnet34").depth_encoder, imagenet_file)


@pytest.mark.parametrize(
    "wrong",
    [
        {"height": 100},
        {"min_depth": 300.0},
        {"min_depth": 0.0},
        {"max_depth": float("nan")},
        {"encoder": "vgg"},
        {"x": 1},
    ],
)
def test_an_impossible_spec_is_refused(wrong):
    with pytest.raises(ValueError, match="validation error"):
        DepthModelSpec(**{**SPEC.model_dump(), **wrong})


def test_a_checkpoint_is_pinned_by_its_hash(tmp_path: Path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(b"weights")
    digest = "9a129472e16bcc1aef2a6e27d8b0ff3a2ecf3e7b7a0b4a7b8f3e2b1f6c7f9a00"
    with pytest.raises(
        CheckpointError, match=rf"model.safetensors: has SHA-256 [0-9a-f]{{64}}, but {digest} is required"
    ):
        check_sha256(path, digest)
    check_sha256(path, hashlib.sha256(b"weights").hexdigest())
    check_sha256(path, "")
