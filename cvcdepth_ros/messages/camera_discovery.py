# SPDX-License-Identifier: Apache-2.0
"""Find the cameras among a recording's or a live system's topics by ROS's naming: one namespace, one camera.

A camera is a namespace with a `camera_info` and at least one image topic (image_pipeline's convention). Not every image
in it is the camera's picture: names, and the first messages where there is a recording, tell depth images, masks and
what was drawn for people.
"""

import re
from collections import defaultdict
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import SequenceMatcher
from typing import NamedTuple

from cvcdepth_core.rig.rig_file import CameraEntry

IMAGE_TYPE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE_TYPE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
IMAGE_TYPES = (IMAGE_TYPE, COMPRESSED_IMAGE_TYPE)
"""Messages that hold one picture each, best first."""
VIDEO_TYPES = ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "foxglove_msgs/msg/CompressedVideo")
RECORDED_IMAGE_TYPES = (*IMAGE_TYPES, *VIDEO_TYPES)
"""What is decoded, best first: a video stream from its key frames on."""

_INFO = "camera_info"
# Image transports whose topics lie below the picture's.
_TRANSPORTS = {"compressed", "ffmpeg", "h264", "h265", "hevc", "foxglove", "video", "encoded"}
_NO_PICTURES = {"compresseddepth", "theora", "zstd"}
_MEASURES = {"depth", "disparity", "confidence", "flow", "normals"}
_MEASURED_NAMESPACES = {"depth", "disparity", "truth"}  # the last of `simulate`
# What perception draws into pictures, or makes of them, in the camera's own namespace as a rule.
_DRAWN = re.compile(
    "mask(s|ed)?|seg(mentation|mented)?|semantics?|label(s|led|ed)?|instances?|panoptic|debug|overlays?|annotat(ed|ions?)|"
    "detect(ions?|ed|or)|bbox(es)?|boxes|visuali[sz](ation|ed)|viz|vis|heatmap|edges?|features?|keypoints|track(s|er|ing)|"
    "results?|thumbnail|preview|marked|blended|yolo"
)
_DRAWN_FOR_CERTAIN = re.compile("masks?|segmentation|semantic|debug|overlay|annotated|detections|visualization")
_DEPTH_PARTS = ("aligned_depth", "depth_to", "depth_regis")
_CAMERA_WORDS = {"camera", "cameras", "cam", "cams"}
_MEASURING_ENCODING = re.compile(r"(16U|16S|32S|32F|64F)C\d+|8SC\d+|8UC2")
_USUAL_NAME = re.compile(
    r"image(_(raw|mono|color|colour|rect|rectified|rgb|compressed))*|rgb|color|colour|frame|video|compressed|h26[45]|hevc"
)
_COLOUR_WORDS = {"color", "colour", "rgb", "bgr"}
# A stream that was recorded from time to time only, while somebody looked at it, has fewer images than the whole.
_WHOLE = 0.9
_SIMILAR = 0.5
_MAX_LISTED = 6


class SeenTopic(NamedTuple):
    """What a recording tells of a topic with images or CameraInfo."""

    messages: int
    """How many there are."""
    encoding: str = ""
    """Of the first image, or what was encoded; empty where it does not say."""
    frame_id: str = ""
    """Of the first message."""
    shifted: bool = False
    """Whether the first CameraInfo is of a stereo pair's other camera, which has the first one's frame."""


@dataclass
class FoundCameras:
    """The cameras among some topics, and what was decided about all others that look like cameras'."""

    cameras: list[CameraEntry]
    """By name; frames and poses are still open."""
    choices: list[str] = field(default_factory=list)
    """Where there were several topics for one camera: which is taken and why, a line each."""
    left_out: list[str] = field(default_factory=list)
    """Which images or CameraInfos are no camera's, and why, a line each reason."""
    without_images: list[str] = field(default_factory=list)
    """The camera_info topics beside which there is no image."""
    without_info: list[str] = field(default_factory=list)
    """The images of cameras, as it seems, beside which there is no camera_info."""
    similar_infos: dict[str, str] = field(default_factory=dict)
    """For some of `without_info` a CameraInfo topic of another name that may be theirs."""

    @property
    def offers(self) -> str:
        """A question that offers the CameraInfo topics of other names; empty where there are none."""
        offered = list(dict.fromkeys(self.similar_infos.values()))
        return f"did you mean {_listed(offered)}? Name it as camera_info_topic in a rig file" if offered else ""


def discover_cameras(topic_types: Mapping[str, str]) -> list[CameraEntry]:
    """Return the cameras found in `topic_types` (topic name -> type), by name; their frames and poses are still open.

    See `find_cameras`.
    """
    return find_cameras(topic_types, image_types=RECORDED_IMAGE_TYPES).cameras


def find_cameras(
    topic_types: Mapping[str, str],
    seen: Mapping[str, SeenTopic] | None = None,
    image_types: Sequence[str] = IMAGE_TYPES,
) -> FoundCameras:
    """Find the cameras among topics (name -> type), and where it is known what was recorded of them, by that too.

    Where a camera has several image topics, whole streams come before those recorded from time to time, rectified
    colour before the rest (its calibration is the simpler one), raw pictures before compressed ones and unrectified
    before rectified (rectifying once, to the network's size, loses least).
    """
    seen = seen or {}
    topic_types = {topic: type_ for topic, type_ in topic_types.items() if not is_output(topic, topic_types)}
    infos = sorted(topic for topic, type_ in topic_types.items() if type_ == CAMERA_INFO_TYPE)
    namespaces = {_parent(topic): topic for topic in infos if _last(topic) == _INFO}
    images = [topic for topic, type_ in topic_types.items() if type_ in image_types]
    reasons = {topic: reason for topic in images if (reason := _why_no_picture(topic, seen.get(topic), namespaces))}
    other_infos = [topic for topic in infos if topic not in namespaces.values()]
    search = _Search(topic_types, seen, namespaces, [topic for topic in images if topic not in reasons], other_infos)
    return search.found(reasons)


class _Search:
    """Pictures, the namespaces with a camera_info, and which belongs to which."""

    def __init__(
        self,
        topic_types: Mapping[str, str],
        seen: Mapping[str, SeenTopic],
        namespaces: Mapping[str, str],
        pictures: Sequence[str],
        other_infos: Sequence[str],
    ) -> None:
        self._types = topic_types
        self._seen = seen
        self._infos = namespaces
        self._below: dict[str, list[str]] = defaultdict(list)
        self._pictures = pictures
        self._other_infos = other_infos
        for topic in pictures:
            if (owner := self._owner(topic)) is not None:
                self._below[owner].append(topic)
        self._of_camera = {namespace: self._ranked(namespace) for namespace in sorted(namespaces)}

    def found(self, reasons: Mapping[str, str]) -> FoundCameras:
        """Choose one image for each namespace, and one namespace for each frame."""
        with_images = {namespace: topics for namespace, topics in self._of_camera.items() if topics}
        twins = self._twins(with_images)
        names = _shortest_unique_names([namespace for namespace in with_images if namespace not in twins])
        cameras = [
            CameraEntry(
                name=name,
                image_topic=with_images[namespace][0],
                camera_info_topic=self._infos[namespace],
                rectified=_is_rectified(with_images[namespace][0]),
            )
            for namespace, name in names.items()
        ]
        owners = {topic: self._owner(topic) for topic in self._pictures}
        of_none = [topic for topic, owner in owners.items() if owner is None or owner not in with_images]
        return FoundCameras(
            cameras,
            [
                self._choice(name, with_images[namespace])
                for namespace, name in names.items()
                if with_images[namespace][1:]
            ],
            [*_grouped(reasons), *self._stray_infos(), *twins.values()],
            [*self._blind(reasons)],
            of_none,
            _similar(of_none, self._other_infos),
        )

    def _owner(self, topic: str) -> str | None:
        """Return the nearest namespace above a topic that has a camera_info; a CameraInfo beside it comes first."""
        beside = _parent(_picture_topic(topic))
        if beside not in self._infos and any(_parent(info) == beside for info in self._other_infos):
            return None
        parts = topic.split("/")
        above = ("/".join(parts[:count]) for count in range(len(parts) - 1, -1, -1))
        return next((namespace for namespace in above if namespace in self._infos), None)

    def _ranked(self, namespace: str) -> list[str]:
        """Return the namespace's pictures, best first; those deeper down only where these are of one camera."""
        topics = self._below[namespace]
        direct = [topic for topic in topics if _parent(_picture_topic(topic)) == namespace]
        if not direct and len({_parent(_picture_topic(topic)) for topic in topics}) > 1:
            return []
        topics = direct or topics
        usual = [topic for topic in topics if _USUAL_NAME.fullmatch(_last(_picture_topic(topic)))] or topics
        most = max((self._count(topic) for topic in usual), default=0)
        return sorted(topics, key=lambda topic: self._rank(topic, most))

    def _rank(self, topic: str, most: int) -> tuple[object, ...]:
        name = _last(_picture_topic(topic))
        return (
            self._count(topic) < _WHOLE * most,
            _USUAL_NAME.fullmatch(name) is None,
            not (_is_rectified(topic) and self._has_colour(topic)),
            RECORDED_IMAGE_TYPES.index(self._types[topic]),
            _is_rectified(topic),
            not self._has_colour(topic) and "image_raw" not in topic,
            "image_raw" not in topic,
            topic,
        )

    def _count(self, topic: str) -> int:
        return self._seen[topic].messages if topic in self._seen else 1

    def _has_colour(self, topic: str) -> bool:
        """Say whether a picture has colours for certain: its name or its encoding tells."""
        encoding = self._seen[topic].encoding if topic in self._seen else ""
        named = bool(_COLOUR_WORDS & set(re.split(r"[/_]", _last(_picture_topic(topic)).lower())))
        return named if not encoding else encoding not in ("mono8", "mono16", "8UC1")

    def _choice(self, name: str, topics: Sequence[str]) -> str:
        taken, *others = topics
        most = max(map(self._count, topics))
        if any(self._count(topic) < _WHOLE * most for topic in others) and self._count(taken) >= _WHOLE * most:
            counts = ", ".join(f"{topic} ({self._count(topic)})" for topic in others[:_MAX_LISTED])
            return f"camera {name}: {taken} is taken, with {self._count(taken)} images, not {counts}"
        why = "rectified" if _is_rectified(taken) else "not rectified yet"
        why += ", in colour" if self._has_colour(taken) else ""
        why += ", compressed" if self._types[taken] != IMAGE_TYPE else ", raw"
        return f"camera {name}: {taken} is taken ({why}), not {_listed(others)}"

    def _twins(self, with_images: Mapping[str, Sequence[str]]) -> dict[str, str]:
        """Say which namespaces show what another one of the same frame shows, and is better at.

        Where all have one frame it says nothing: then nobody gave the cameras frames of their own.
        """
        frames: dict[str, list[str]] = defaultdict(list)
        for namespace in with_images:
            info = self._seen.get(self._infos[namespace])
            frames[info.frame_id if info and info.frame_id else f"\0{namespace}"].append(namespace)
        if len(frames) < 2:
            return {}
        told: dict[str, str] = {}
        for frame, same in frames.items():
            best, *others = sorted(
                same, key=lambda namespace: self._order_of_twins(namespace, with_images[namespace][0])
            )
            for other in others:
                what = f"{with_images[best][0]} has the same frame '{frame}'"
                told[other] = f"{with_images[other][0]} is left out: {what}"
        return told

    def _order_of_twins(self, namespace: str, topic: str) -> tuple[bool, bool, tuple[object, ...]]:
        info = self._seen.get(self._infos[namespace])
        # What has depth below it was made of the camera's picture, by our own node perhaps.
        is_made = any(other.startswith(f"{namespace}/depth/") for other in self._types)
        return info is not None and info.shifted, is_made, self._rank(topic, 0)

    def _stray_infos(self) -> Iterator[str]:
        """Tell the camera_infos above other cameras' namespaces to which no image of their own belongs."""
        for namespace in self._of_camera:
            if self._is_stray(namespace):
                yield f"{self._infos[namespace]} is of no camera: the images below it are of several others"

    def _is_stray(self, namespace: str) -> bool:
        is_above = any(topic.startswith(f"{namespace}/") for topic in self._pictures)
        return is_above and not self._of_camera[namespace]

    def _blind(self, reasons: Mapping[str, str]) -> Iterator[str]:
        for namespace, topics in self._of_camera.items():
            is_other = any(topic.startswith(f"{namespace}/") for topic in reasons)
            if not topics and not is_other and not self._is_stray(namespace) and not _measures(namespace):
                yield self._infos[namespace]


def _why_no_picture(topic: str, seen: SeenTopic | None, cameras: Collection[str]) -> str | None:
    """Say why an image is not what a camera saw; None where it may be. `cameras` are namespaces with a camera_info."""
    if seen is not None and _MEASURING_ENCODING.fullmatch(seen.encoding):
        return f"encoding {seen.encoding} is that of depth or other measurements"
    parts = [part.lower() for part in topic.split("/") if part]
    if any(part in _NO_PICTURES for part in parts):
        return "this image transport is not read"
    picture = _picture_topic(topic)
    name, namespace = _words(_last(picture)), _parent(picture)
    if _measures(namespace) or _MEASURES & name:
        return "the name is that of depth or other measurements"
    # A camera may be called as it likes.
    name |= set() if namespace in cameras else _words(_last(namespace))
    if any(map(_DRAWN.fullmatch, name)) or any(map(_is_drawn_for_certain, parts)):
        return "the name is that of masks or drawings"
    return None


def _measures(namespace: str) -> bool:
    """Say whether a namespace is that of depth images, aligned or registered ones too."""
    parts = [part.lower() for part in namespace.split("/") if part]
    if any(part in _MEASURED_NAMESPACES or part.startswith(_DEPTH_PARTS) for part in parts):
        return True
    last = _words(*parts[-1:])
    return bool(_MEASURED_NAMESPACES & last) and not _CAMERA_WORDS & last


def _is_drawn_for_certain(part: str) -> bool:
    words = _words(part)
    return any(map(_DRAWN_FOR_CERTAIN.fullmatch, words)) and not _CAMERA_WORDS & words


def _words(*parts: str) -> set[str]:
    return {word for part in parts for word in part.lower().split("_")}


def _is_rectified(topic: str) -> bool:
    return "image_rect" in topic


def _picture_topic(topic: str) -> str:
    """Return the topic without its image transport's part, where what is before that names a picture."""
    parent = _parent(topic)
    is_transport = _last(topic).lower() in _TRANSPORTS and (_words(_last(parent)) & {"image", "rgb", "color"})
    return parent if is_transport else topic


def _parent(topic: str) -> str:
    return topic.rpartition("/")[0]


def _last(topic: str) -> str:
    return topic.rpartition("/")[2]


def _similar(images: Sequence[str], infos: Sequence[str]) -> dict[str, str]:
    """Return for each image the CameraInfo topic whose name is the most similar, where one is."""
    found = {}
    for image in images:
        beside = [info for info in infos if _parent(info) == _parent(_picture_topic(image))]
        ratios = {info: SequenceMatcher(None, image, info).ratio() for info in beside or infos}
        best = max(ratios, key=ratios.__getitem__, default=None)
        if best is not None and (beside or ratios[best] >= _SIMILAR):
            found[image] = best
    return found


def _grouped(reasons: Mapping[str, str]) -> Iterator[str]:
    """Tell the topics of each reason in one line."""
    topics: dict[str, list[str]] = defaultdict(list)
    for topic, reason in reasons.items():
        topics[reason].append(topic)
    for reason, names in topics.items():
        yield f"no camera's picture is {_listed(names)}: {reason}"


def _listed(topics: Sequence[str]) -> str:
    more = f" and {len(topics) - _MAX_LISTED} more" if len(topics) > _MAX_LISTED else ""
    return ", ".join(topics[:_MAX_LISTED]) + more


def is_output(topic: str, topics: Container[str]) -> bool:
    """Whether a topic is the rectified picture, or its camera_info, that a node or `run` of ours has put out.

    They stand beside the depth of the same picture, where a camera's raw pictures do not.
    """
    namespace = topic.rpartition("/")[0]
    beside = ("image_rect", "depth/image_rect", "depth/camera_info")
    return all(f"{namespace}/{part}" in topics for part in beside) and f"{namespace}/image_raw" not in topics


def _shortest_unique_names(namespaces: list[str]) -> dict[str, str]:
    """Call each camera by the last part of its namespace, by more parts where that is not unique, else numbered."""
    parts = {namespace: namespace.strip("/").split("/") for namespace in namespaces}
    depth = max((len(found) for found in parts.values()), default=1)
    for count in range(1, depth + 1):
        names = {namespace: _camera_name("_".join(found[-count:])) for namespace, found in parts.items()}
        if len(set(names.values())) == len(names):
            return names
    return {namespace: f"{name}_{number}" for number, (namespace, name) in enumerate(names.items())}


def _camera_name(topic_part: str) -> str:
    """Make a camera's name of a part of a topic, which may be empty, a number, or of no ROS system's characters."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", topic_part)
    return name if name[:1].isalpha() else f"camera_{name}".rstrip("_")
