# SPDX-License-Identifier: Apache-2.0
"""Recordings behind URLs: read by seeking on a local S3 server, and in fsspec's memory where no server is needed."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import recordings
from recordings import SAMPLE, SAMPLE_MCAP
from s3_server import BUCKET, LocalS3

from cvcdepth_core.errors import ConfigError, RecordingError
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import RemotePath, find_recordings, open_recording

SIZE = SAMPLE_MCAP.stat().st_size


@pytest.fixture(scope="module")
def url(s3: LocalS3, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The sample in many small chunks on the server."""
    path = tmp_path_factory.mktemp("chunks") / "drive.mcap"
    recordings.write_mcap(path, recordings.sample_entries())
    assert len(recordings.stored_chunks(path)) > 15
    return s3.put(path, "2026/drive.mcap")


def test_a_recording_behind_a_url_gives_the_same_messages(url: str):
    with open_recording(url) as remote, open_recording(SAMPLE) as local:
        assert list(remote.messages()) == list(local.messages())
        assert remote.topics.keys() == local.topics.keys()
        assert str(remote.path) == url
        assert remote.damage is None


def test_only_the_chunks_of_the_time_that_is_asked_for_are_fetched(url: str, s3: LocalS3):
    with open_recording(SAMPLE) as local:
        start, stop = local.start + 400_000_000, local.start + 500_000_000
        wanted = list(local.messages(start=start, stop=stop))
    before = s3.sent
    with open_recording(url) as recording:
        opening = s3.sent - before
        assert list(recording.messages(start=start, stop=stop)) == wanted
    assert len(wanted) > 20
    assert opening < 0.2 * SIZE
    assert 0.1 * SIZE < s3.sent - before < 0.5 * SIZE


def test_a_window_that_is_read_again_is_not_fetched_again(url: str, s3: LocalS3):
    with open_recording(url) as recording:
        window = {"start": recording.start + 400_000_000, "stop": recording.start + 500_000_000}
        first = list(recording.messages(**window))
        before = s3.sent
        assert list(recording.messages(**window)) == first
        assert s3.sent == before
        cameras = [topic for topic in recording.topics if topic.endswith("compressed")]
        assert list(recording.messages(cameras, **window)) == [m for m in first if m.topic in cameras]
        assert s3.sent == before


def test_a_window_of_a_recording_behind_a_url_is_inspected_for_less_than_the_whole(
    url: str, s3: LocalS3, capsys: pytest.CaptureFixture[str]
):
    before = s3.sent
    assert main(["inspect", url, "--start", "0.4", "--duration", "0.1", "--json"]) == 0
    (summary,) = json.loads(capsys.readouterr().out)["recordings"]
    messages = {topic["name"]: topic["timing"]["messages"] for topic in summary["topics"]}
    assert messages["/camera/front/image_raw/compressed"] == 1
    assert (summary["path"], summary["index"]) == (url, "intact")
    assert s3.sent - before < 0.5 * SIZE


def test_patterns_and_folders_of_a_bucket_are_found(s3: LocalS3, tmp_path: Path):
    s3.put(SAMPLE_MCAP, "found/b.mcap")
    s3.put(SAMPLE_MCAP, "found/deeper/a.mcap")
    s3.put(SAMPLE / "metadata.yaml", "found/deeper/notes.yaml")
    folder = f"s3://{BUCKET}/found"
    assert list(map(str, find_recordings([f"{folder}/*.mcap"]))) == [f"{folder}/b.mcap"]
    every = [f"{folder}/b.mcap", f"{folder}/deeper/a.mcap"]
    assert list(map(str, find_recordings([folder, f"{folder}/b.mcap", f"{folder}/**/*.mcap"]))) == every


def test_a_split_rosbag2_folder_in_a_bucket_is_one_recording(s3: LocalS3, tmp_path: Path):
    path = recordings.split_copy(tmp_path / "bag")
    for file in path.iterdir():
        s3.put(file, f"split/bag/{file.name}")
    (found,) = find_recordings([f"s3://{BUCKET}/split/"])
    assert str(found) == f"s3://{BUCKET}/split/bag"
    with open_recording(found) as recording, open_recording(SAMPLE) as local:
        assert list(recording.messages()) == list(local.messages())
        assert recording.damage is None


def test_a_cut_recording_behind_a_url_is_read_up_to_the_cut(s3: LocalS3, tmp_path: Path):
    cut = s3.put(recordings.cut(SAMPLE_MCAP, tmp_path / "cut.mcap"), "cut.mcap")
    with open_recording(cut) as recording:
        assert len(list(recording.messages())) > 100
        assert "recovered" in (recording.damage or "")


def test_what_cannot_be_sought_in_is_refused_by_name(s3: LocalS3, tmp_path: Path):
    database = recordings.sqlite_copy(tmp_path / "bag", sets=1) / "bag.db3"
    url = s3.put(database, "databases/bag.db3")
    with pytest.raises(RecordingError, match=r"databases/bag.db3: only .mcap can be read through a URL"):
        find_recordings([f"s3://{BUCKET}/databases"])
    with pytest.raises(RecordingError, match=r"bag.db3: begins with b'SQLite.*behind a URL only MCAP"):
        open_recording(url)


def test_what_is_not_there_is_named(s3: LocalS3):
    with pytest.raises(RecordingError, match=rf"s3://{BUCKET}/nothing.mcap: does not exist"):
        open_recording(f"s3://{BUCKET}/nothing.mcap")
    with pytest.raises(RecordingError, match=rf"s3://{BUCKET}/none/\*.mcap: no recording there"):
        find_recordings([f"s3://{BUCKET}/none/*.mcap"])


def test_a_bucket_that_cannot_be_reached_is_one_line(capsys: pytest.CaptureFixture[str], s3: LocalS3):
    assert main(["inspect", "s3://no-such-bucket/drive.mcap"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "s3://no-such-bucket/drive.mcap" in line


def test_a_storage_that_is_not_installed_is_named_with_the_remedy():
    with pytest.raises(ConfigError, match=r"gs://bucket/a.mcap: .*cvcdepth_ros\[s3\]"):
        open_recording("gs://bucket/a.mcap")


def test_without_fsspec_a_url_is_refused_in_one_line_and_paths_are_read():
    program = "import sys; sys.modules['fsspec'] = None; from cvcdepth_ros.bag_replay import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "inspect", "--quiet"]
    refused = subprocess.run([*command, "s3://bucket/a.mcap"], capture_output=True, text=True, check=False)
    assert (refused.returncode, len(refused.stderr.splitlines())) == (1, 1)
    assert "pip install 'cvcdepth_ros[s3]'" in refused.stderr
    read = subprocess.run([*command, str(SAMPLE)], capture_output=True, text=True, check=False)
    assert read.returncode == 0, read.stderr


def test_other_storages_of_fsspec_are_read_too():
    fsspec = pytest.importorskip("fsspec")
    fsspec.filesystem("memory").pipe("/drives/a.mcap", SAMPLE_MCAP.read_bytes())
    (found,) = find_recordings(["memory://drives"])
    with open_recording(found) as recording:
        assert len(list(recording.messages())) == 271


def test_a_file_url_is_a_path():
    (found,) = find_recordings([f"file://{SAMPLE_MCAP}"])
    assert found == SAMPLE_MCAP


def test_the_name_behind_a_signed_url_is_that_of_the_file():
    assert RemotePath("https://host/bucket/drive.mcap?signature=a/b").name == "drive.mcap"
