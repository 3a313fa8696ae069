# SPDX-License-Identifier: Apache-2.0
"""Publishers about the joints of objects, which cost nothing while nobody listens."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, TwistStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState, MultiDOFJointState
from std_msgs.msg import String

from deep_nrsfm_ros.body.kinematic_tree import KinematicTree, Pose
from deep_nrsfm_ros.body.motion import INTERVALS, LOST_TIME, Motion, MotionTracker
from deep_nrsfm_ros.body.urdf import rep155_name, urdf
from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.messages.stamps import Moment, RateLimit
from deep_nrsfm_ros.node import body_messages, publishing
from deep_nrsfm_ros.node.message_types import message_class

Floats = NDArray[Any]

HUMANS = "/humans/bodies"
IDS_LIST = "hri_msgs/IdsList"
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_MAX_BODIES = 100  # objects with topics of their own
_LENGTHS_TIME = 5.0  # s, time constant of the mean lengths of an object's bones
_FIRST_SILENCE = 5.0  # s without a second message after which a topic is silent
_URDF_PERIOD = 5.0  # s between two URDFs of an object at least
_URDF_CHANGE = 0.05  # of the length of a bone, from which on the URDF is published again


@dataclass(frozen=True)
@described
class BodyOptions:
    """Joints."""

    frames: bool = option(
        False,
        "whether /tf has a frame for each joint of an object whose layout names its joints: "
        "tf_prefix, identity, / and joint, as in person1/left_elbow, each in the frame of its "
        "parent; needs tf_prefix",
        read_only=True,
    )
    per_object: bool = option(
        False,
        "whether each object has topics of its own: ~/IDENTITY/joint_states, urdf (latched), "
        "position and velocity; robot_state_publisher and RViz show a person with them",
        read_only=True,
    )
    humans: bool = option(
        False,
        "whether people are published as ROS4HRI (REP-155) has them: /humans/bodies/tracked (needs "
        "hri_msgs), and joint_states, urdf, position and velocity under /humans/bodies/IDENTITY, "
        "with names as in l_elbow_IDENTITY; the frame body_IDENTITY on /tf where tf2_msgs is "
        "installed",
        read_only=True,
    )
    motion_rate: float = option(
        10.0,
        "most messages a second on the topics position and velocity of each object, in Hz; angles "
        "go out with each message of keypoints; 0 = with each message, 10 typical",
        low=0.0,
        high=1000.0,
        read_only=True,
    )
    velocity_time: float = option(
        0.1,
        "time constant in s of the low-pass of velocities, which is their lag (and half an "
        "interval between messages); 0 = no filter, 0.1 typical, 0.5 strong",
        low=0.0,
        high=10.0,
        read_only=True,
    )


class _Body:
    """The topics of one object under one prefix, and the lengths of its bones."""

    def __init__(
        self, node: Node, prefix: str, rename: Callable[[str], str], motion_rate: float
    ) -> None:
        """Create the publishers.

        Args:
            node: owns them.
            prefix: of their topics.
            rename: returns the name of a joint or an angle of the layout as the topics have it.
            motion_rate: most messages a second of position and velocity, in Hz; 0: no limit.
        """
        self.node, self.rename = node, rename
        self.motion_limit = RateLimit(motion_rate)
        self._names: tuple[str, ...] = ()
        self._titles: tuple[str, ...] = ()
        quiet: Any = {"event_callbacks": publishing.NO_EVENT_CALLBACKS}
        self.angles = node.create_publisher(JointState, f"{prefix}/joint_states", 10, **quiet)
        self.urdf = node.create_publisher(String, f"{prefix}/urdf", _LATCHED, **quiet)
        self.position = node.create_publisher(PointStamped, f"{prefix}/position", 10, **quiet)
        self.velocity = node.create_publisher(TwistStamped, f"{prefix}/velocity", 10, **quiet)

    def titles(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names as this object's topics have them."""
        if names is not self._names:
            self._names, self._titles = names, tuple(map(self.rename, names))
        return self._titles

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in (self.angles, self.urdf, self.position, self.velocity):
            self.node.destroy_publisher(publisher)


class _Lengths:
    """The mean offsets of the joints of one object, and those of its last URDF.

    Every few seconds they are compared.
    """

    def __init__(self) -> None:
        """Start without lengths."""
        self.offsets: Floats | None = None
        self._published: Floats | None = None
        self._seconds = self._last = 0.0

    def update(self, offsets: Floats, seconds: float) -> bool:
        """Average the offsets (j, 3); return whether a URDF of them is due."""
        if self.offsets is None:
            self.offsets = offsets
        else:
            step = min(max(seconds - self._seconds, 0.0), _LENGTHS_TIME)
            self.offsets = self.offsets + step / (_LENGTHS_TIME + step) * (offsets - self.offsets)
        self._seconds = seconds
        if self._published is not None:
            if seconds < self._last + _URDF_PERIOD:
                return False
            self._last = seconds
            old, new = (np.linalg.norm(o, axis=1) for o in (self._published, self.offsets))
            if (np.abs(new - old) <= _URDF_CHANGE * np.maximum(old, 1e-9)).all():
                return False
        self._published, self._last = self.offsets, seconds
        return True


class Scene(NamedTuple):
    """What a message has shown.

    Attributes:
        header: of the points.
        lifted: n objects.
        identities: n.
        detected: number of the first objects that the message contained; smoothing keeps others.
        moment: time of the message.
    """

    header: Header
    lifted: Lifted
    identities: Sequence[str]
    detected: int
    moment: Moment


class BodyPublishers:
    """Publishes frames, angles, velocities and states of objects on their topics.

    Attributes:
        wanted: whether the last message had a subscriber to a topic that needs identities.
    """

    def __init__(self, node: Node, options: BodyOptions, tf_prefix: str) -> None:
        """Create the publishers of the node itself.

        Args:
            node: owns the publishers.
            options: what is published.
            tf_prefix: of the names of frames.

        Raises:
            ValueError: `frames` without a prefix, or a package is missing.
        """
        if options.frames and not tf_prefix:
            raise ValueError(
                "body.frames is true without tf_prefix: frames of joints hang below those of "
                "objects; set tf_prefix, for example to person"
            )
        self._node, self._options, self._prefix = node, options, tf_prefix
        self._outbox = publishing.Outbox()
        quiet: Any = {"event_callbacks": publishing.NO_EVENT_CALLBACKS}
        self._skeleton = node.create_publisher(String, "~/skeleton", _LATCHED, **quiet)
        self._joints = node.create_publisher(MultiDOFJointState, "~/joints", 10, **quiet)
        self._angles = node.create_publisher(JointState, "~/joint_states", 10, **quiet)
        self._tracks = node.create_publisher(DiagnosticArray, "~/tracks", 10, **quiet)
        self._tf: Publisher | None = None
        self._ids: Publisher | None = None
        self._ids_message: Any = None
        if options.frames or options.humans:
            self._create_tf(required=options.frames)
        if options.humans:
            self._create_ids()
        self._described: KeypointLayout | None = None
        self._tree: KinematicTree | None = None
        self._motions: dict[str, MotionTracker] = {}
        self._last: dict[str, tuple[int, Header, Moment]] = {}  # node's ns, of the last message
        self._bodies: dict[str, list[_Body]] = {}
        self._lengths: dict[str, _Lengths] = {}
        self.wanted = self._always = options.frames or options.per_object or options.humans

    def _create_tf(self, *, required: bool) -> None:
        """Create the publisher of frames."""
        try:
            message = message_class("tf2_msgs/TFMessage")
        except ValueError:
            if required:
                raise
            self._node.get_logger().warning(
                "body.humans is true and tf2_msgs is missing: the frames body_IDENTITY are not "
                "on /tf; install it (apt install ros-jazzy-tf2-msgs)"
            )
            return
        self._frames = body_messages.FrameMessages(message)
        self._tf = self._node.create_publisher(message, "/tf", 100)

    def _create_ids(self) -> None:
        """Create the publisher of the list of bodies, where its message is installed."""
        try:
            self._ids_message = message_class(IDS_LIST)
        except ValueError:
            self._node.get_logger().warning(
                f"body.humans is true and hri_msgs is missing: {HUMANS}/tracked is not published; "
                "install it (apt install ros-jazzy-hri-msgs)"
            )
            return
        self._ids = self._node.create_publisher(self._ids_message, f"{HUMANS}/tracked", _LATCHED)

    def describe(self, layout: KeypointLayout) -> None:
        """Publish the names of a layout, latched, if it is another one than before."""
        if layout is self._described:
            return
        self._described = layout
        self._tree = KinematicTree(layout) if layout.joints else None
        self._lengths.clear()
        self._motions.clear()
        self._last.clear()
        self._skeleton.publish(body_messages.skeleton(layout))

    def has_subscriber(self) -> bool:
        """Return whether anything is to be published; it also sets `wanted`."""
        publishers = (self._joints, self._angles, self._tracks)
        self.wanted = self._always or any(p.get_subscription_count() for p in publishers)
        return self.wanted

    def publish(self, topic: str, scene: Scene, *, positioned: bool) -> None:
        """Publish what somebody listens to.

        Args:
            topic: of the message; each topic has its own identities.
            scene: what it has shown.
            positioned: whether the shapes are at their positions, not centred.
        """
        try:
            lost = self._make(topic, scene, positioned=positioned).lost
        finally:
            self._outbox.send()
        self._forget(lost)

    def tell_lost(self) -> None:
        """Tell that identities are lost on topics without a message; call it twice a second.

        A detector may send nothing where it sees nobody.
        """
        if not self.wanted:
            return
        now = self._node.get_clock().now().nanoseconds
        for topic, (received, header, moment) in [*self._last.items()]:
            silence = 1e-9 * (now - received)
            if silence < _silent_time(moment.period):
                continue
            nobody = np.zeros((0, 1, 3))
            tracker = self._motions[topic]
            motion = tracker((), nobody, moment.seconds + silence, moment.period)
            if not motion.lost:
                if not len(tracker):
                    del self._last[topic]
                continue
            self._forget(motion.lost)
            header = header.later(now - received)
            if self._tracks.get_subscription_count():
                self._outbox.add(
                    self._tracks, body_messages.tracks(header, (), motion, np.zeros(0))
                )
            if self._options.humans:
                self._make_ids(header)
            self._outbox.send()

    def _make(self, topic: str, scene: Scene, *, positioned: bool) -> Motion:
        """Make the messages of `publish`; return the motion of the objects."""
        joints = self._joints.get_subscription_count()
        angles = self._angles.get_subscription_count()
        tracks = self._tracks.get_subscription_count()
        header, tree = scene.header, self._tree
        lifted = np.isfinite(scene.lifted.residual)
        pose = tree(scene.lifted.shapes) if tree else None
        places = (
            scene.lifted.shapes.mean(1)[:, None].astype(float) if pose is None else pose.origins
        )
        names = [identity or str(i) for i, identity in enumerate(scene.identities)]
        motion = self._motion(topic, names, places, scene)
        if tracks:
            confidence = scene.lifted.object_confidence
            self._outbox.add(self._tracks, body_messages.tracks(header, names, motion, confidence))
        if pose is None or tree is None or not lifted.any():
            return motion
        shown = tuple(name for name, known in zip(names, lifted, strict=True) if known)
        pose = Pose(*(part[lifted] for part in pose))
        velocities = motion.velocities[lifted]
        if joints:
            titles = body_messages.joint_names(shown, tree.names)
            self._outbox.add(self._joints, body_messages.joints(header, titles, pose, velocities))
        if angles:
            titles = body_messages.joint_names(shown, tree.angle_names)
            self._outbox.add(self._angles, body_messages.angles(header, titles, pose.angles))
        if self._options.frames and self._tf:
            titles = body_messages.joint_names(
                tuple(self._prefix + name for name in shown), tree.names
            )
            self._outbox.add(self._tf, self._frames(header, pose, tree.parents, titles))
        if self._options.per_object or self._options.humans:
            self._make_bodies(scene, shown, pose, velocities if positioned else None)
        return motion

    def _motion(self, topic: str, names: Sequence[str], places: Floats, scene: Scene) -> Motion:
        """Return the motion of the objects of a message."""
        tracker = self._motions.get(topic)
        if tracker is None:
            tracker = self._motions[topic] = MotionTracker(self._options.velocity_time)
        moment = scene.moment
        self._last[topic] = self._node.get_clock().now().nanoseconds, scene.header, moment
        bridged = len(names) - scene.detected
        return tracker(names, places, moment.seconds, moment.period, bridged)

    def _make_bodies(
        self, scene: Scene, names: Sequence[str], pose: Pose, velocities: Floats | None
    ) -> None:
        """Make the messages of each object; velocities are None where positions are not known."""
        tree, header, seconds = self._tree, scene.header, scene.moment.seconds
        assert tree
        offsets = tree.offsets(pose)
        for i, name in enumerate(names):
            bodies = self._bodies.get(name)
            if bodies is None:
                if len(self._bodies) >= _MAX_BODIES:
                    continue
                bodies = self._bodies[name] = self._create_bodies(name)
            lengths = self._lengths.setdefault(name, _Lengths())
            due = lengths.update(offsets[i], seconds)
            for body in bodies:
                if due and lengths.offsets is not None:
                    text = urdf(tree, lengths.offsets, topic_name(name), body.rename)
                    self._outbox.add(body.urdf, String(data=text))
                if body.angles.get_subscription_count():
                    titles = body.titles(tree.angle_names)
                    angles = body_messages.angles(header, titles, pose.angles[i])
                    self._outbox.add(body.angles, angles)
                if velocities is None or not body.motion_limit.is_due(scene.moment):
                    continue
                if body.position.get_subscription_count():
                    position = body_messages.position(header, pose.origins[i, 0])
                    self._outbox.add(body.position, position)
                if body.velocity.get_subscription_count():
                    velocity = body_messages.velocity(header, velocities[i, 0])
                    self._outbox.add(body.velocity, velocity)
        if self._options.humans:
            self._make_ids(header)
            if self._tf and velocities is not None:
                roots = Pose(pose.origins[:, :1], pose.rotations[:, :1], pose.angles)
                titles = tuple(f"body_{topic_name(name)}" for name in names)
                self._outbox.add(self._tf, self._frames(header, roots, (-1,), titles))

    def _make_ids(self, header: Header) -> None:
        """Make the list of bodies."""
        if self._ids:
            ids = [topic_name(name) for name in self._bodies]
            stamped = self._ids_message(header=publishing.to_header(header), ids=ids)
            self._outbox.add(self._ids, stamped)

    def _create_bodies(self, name: str) -> list[_Body]:
        """Create the topics of an object."""
        own, bodies, rate = topic_name(name), [], self._options.motion_rate
        if self._options.per_object:
            bodies.append(_Body(self._node, f"~/{own}", str, rate))
        if self._options.humans:
            bodies.append(_Body(self._node, f"{HUMANS}/{own}", rep155_name(own), rate))
        return bodies

    def forget(self) -> None:
        """Forget all objects and destroy their topics."""
        self._motions.clear()
        self._last.clear()
        self._forget([*self._bodies])

    def _forget(self, lost: Sequence[str]) -> None:
        """Destroy the topics of identities that are lost."""
        for name in lost:
            self._lengths.pop(name, None)
            for body in self._bodies.pop(name, ()):
                body.close()


def _silent_time(period: float) -> float:
    """Return the seconds without a message after which a topic is silent.

    Args:
        period: typical interval between its messages in seconds; 0: unknown.
    """
    return max(LOST_TIME, INTERVALS * period) if period else _FIRST_SILENCE


def topic_name(identity: str) -> str:
    """Return an identity as part of the name of a topic: letters, digits and underscores."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", identity)
    return name if name[:1].isalpha() else f"id_{name}"
