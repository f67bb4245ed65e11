# SPDX-License-Identifier: Apache-2.0
"""The node's subscriptions (images, camera_info, static transforms), and why nothing arrives on one."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo

from cvcdepth_core.errors import ConfigError, TransformError
from cvcdepth_core.rig.rig_file import CameraEntry, RigLayout
from cvcdepth_ros.live.camera_states import CameraState, Trouble
from cvcdepth_ros.live.video_streams import video_problem
from cvcdepth_ros.messages.camera_discovery import RECORDED_IMAGE_TYPES, VIDEO_TYPES
from cvcdepth_ros.messages.conversion import ros_message_class
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.node.qos import INPUT_DEPTH, SubscriptionEventCallbacks, input_qos, refusing_impossible_qos

_VIDEO_DEPTH = 100  # messages: a lost packet costs all until the next key frame


def topic_types(node: Node) -> dict[str, list[str]]:
    """Return the types of every topic in the graph."""
    return dict(node.get_topic_names_and_types())


class CameraInputs:
    """Subscribes each camera's topics, images as soon as the graph tells whether they are raw, compressed or video."""

    def __init__(
        self,
        node: Node,
        layout: RigLayout,
        reliable: bool,
        on_image: Callable[[list[str], Any], None],
        on_camera_info: Callable[[list[str], Any], None],
    ) -> None:
        """Both callbacks get the camera's name first, or the names of all that are views of one lens.

        They run on the executor's thread and must be short.

        ConfigError names a camera_info topic that cannot be subscribed.
        """
        self._node = node
        self._cameras: dict[str, _CameraInput] = {}
        try:
            for camera in layout.cameras:
                names = layout.views_by_image[camera.image_topic]
                if camera.name == names[0]:
                    callbacks = partial(on_image, names), partial(on_camera_info, names)
                    self._cameras |= dict.fromkeys(names, _CameraInput(node, camera, reliable, *callbacks))
        except ConfigError:
            self.close()
            raise

    @property
    def image_topics(self) -> list[str]:
        """The graph's names of the cameras' image topics, whether they are there or not."""
        return [camera.image_topic for camera in self._inputs]

    @property
    def lost(self) -> dict[str, int]:
        """Messages that the middleware lost, by camera."""
        return {name: camera.lost for name, camera in self._cameras.items()}

    def connect(self) -> None:
        """Subscribe the image topics that have appeared since the last call."""
        types = topic_types(self._node)
        for camera in self._inputs:
            camera.connect(types)

    def troubles(self) -> dict[str, list[Trouble]]:
        """Return for each camera why no image can arrive."""
        types = topic_types(self._node)
        return {name: camera.troubles(types) for name, camera in self._cameras.items()}

    def close(self) -> None:
        """Drop all subscriptions."""
        for camera in self._inputs:
            camera.close()

    @property
    def _inputs(self) -> list["_CameraInput"]:
        """Each once, whether one camera's or that of all views of a lens."""
        return list(dict.fromkeys(self._cameras.values()))


class _CameraInput:
    """The subscriptions of one camera, or of all that are views of one lens."""

    def __init__(
        self,
        node: Node,
        camera: CameraEntry,
        reliable: bool,
        on_image: Callable[[Any], None],
        on_camera_info: Callable[[Any], None],
    ) -> None:
        self._node = node
        self._camera = camera
        self._reliable = reliable
        self._on_image = on_image
        self.image_topic = _resolved(node, camera.image_topic)
        """Its whole name, after remapping."""
        self._refusal = ""
        self.lost = 0
        self._images: Subscription | None = None
        self._camera_info = self._subscribe(CameraInfo, camera.camera_info_topic, on_camera_info)

    def connect(self, types: Mapping[str, Sequence[str]]) -> None:
        """Subscribe the images if their topic is there and has been tried neither with success nor without."""
        known = [name for name in types.get(self.image_topic, ()) if name in RECORDED_IMAGE_TYPES]
        if known and self._images is None and not self._refusal:
            depth = _VIDEO_DEPTH if known[0] in VIDEO_TYPES else INPUT_DEPTH
            try:
                message_class = _image_class(known[0], self.image_topic)
                self._images = self._subscribe(message_class, self._camera.image_topic, self._on_image, depth)
            except ConfigError as error:
                self._refusal = str(error)

    def troubles(self, types: Mapping[str, Sequence[str]]) -> list[Trouble]:
        """Return why no image can arrive."""
        subscriptions = filter(None, (self._camera_info, self._images))
        mismatches = filter(None, map(self._qos_mismatch, subscriptions))
        return [*self._image_troubles(types), *((CameraState.REJECTED, mismatch) for mismatch in mismatches)]

    def close(self) -> None:
        for subscription in filter(None, (self._camera_info, self._images)):
            self._node.destroy_subscription(subscription)

    def _image_troubles(self, types: Mapping[str, Sequence[str]]) -> list[Trouble]:
        topic = self.image_topic
        if not self._node.count_publishers(topic):
            return [(CameraState.WAITING_FOR_IMAGES, f"no publisher on {topic}")]
        if self._refusal:
            return [(CameraState.REJECTED, self._refusal)]
        if self._images is None:
            unusable = f"{topic} carries {', '.join(types.get(topic, ()))}, want {' or '.join(RECORDED_IMAGE_TYPES)}"
            return [(CameraState.REJECTED, unusable)]
        return []

    def _qos_mismatch(self, subscription: Subscription) -> str:
        """Return how a publisher's QoS does not match; asked of the graph, for rclpy's event was seen not to come."""
        topic = subscription.topic_name
        for publisher in self._node.get_publishers_info_by_topic(topic):
            compatibility, reason = qos_check_compatible(publisher.qos_profile, subscription.qos_profile)
            if compatibility == QoSCompatibility.ERROR:
                return f"{topic}: QoS does not match: {reason} See the parameters reliable and qos_overrides."
        return ""

    def _subscribe(
        self, message_class: type, topic: str, callback: Callable[[Any], None], depth: int = INPUT_DEPTH
    ) -> Subscription:
        def message_lost(event: Any) -> None:
            self.lost += event.total_count_change

        with refusing_impossible_qos(topic):
            return self._node.create_subscription(
                message_class,
                topic,
                callback,
                # Overrides are written into the profile that is handed over: each subscription needs its own.
                input_qos(self._reliable, depth),
                event_callbacks=SubscriptionEventCallbacks(message_lost=message_lost),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )


def _image_class(type_name: str, topic: str) -> Any:
    """Return the class of a type of images; ConfigError names what is to be installed for it."""
    if type_name in VIDEO_TYPES and (problem := video_problem()):
        raise ConfigError(f"{topic}: {problem}")
    try:
        return ros_message_class(type_name)
    except (ImportError, AttributeError) as error:
        package = type_name.partition("/")[0]
        debian = f"ros-$ROS_DISTRO-{package.replace('_', '-')}"
        raise ConfigError(
            f"{topic} carries {type_name}, whose package is not installed: apt install {debian}, or source a workspace "
            f"with {package}"
        ) from error


def _resolved(node: Node, topic: str) -> str:
    """Return the name by which the graph knows a topic: whole, and after remapping."""
    try:
        return str(node.resolve_topic_name(topic))
    except RuntimeError as error:  # rclpy's RCLError, which has no public name
        raise ConfigError(f"image_topic '{topic}': {error}") from error


class StaticTransformInput:
    """Subscribes `/tf_static`. Where tf2_msgs is not installed (the wheels lack it), building it is a ConfigError."""

    def __init__(self, node: Node, tree: TransformTree, on_change: Callable[[], None] = lambda: None) -> None:
        """Add the transforms to `tree`, log those that contradict it, and call `on_change` after each message."""
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError as error:
            raise ConfigError(
                "the rig file leaves base_T_camera to /tf_static, but tf2_msgs is not installed here; "
                "write a complete rig file with: cvcdepth rig BAG -o rig.yaml"
            ) from error
        self._node, self._tree, self._on_change = node, tree, on_change
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=100,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self._subscription = node.create_subscription(TFMessage, "/tf_static", self._on_message, qos)

    def close(self) -> None:
        """Drop the subscription."""
        self._node.destroy_subscription(self._subscription)

    def _on_message(self, message: Any) -> None:
        try:
            self._tree.add_message(message)
        except TransformError as error:
            self._node.get_logger().error(f"/tf_static: {error}", throttle_duration_sec=5.0)
        self._on_change()
