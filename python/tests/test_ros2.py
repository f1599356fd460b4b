"""examples/ros2/rope_follower.py with stand-ins for ROS 2: what it publishes is what the module says.

The stand-ins have the fields of the message types that the node uses, and no others: a field that ROS 2 does not have is an
error here too.
"""
import importlib.util
import logging
import os
import pathlib
import sys
import tempfile
import types
import unittest

import numpy as np

import chainsplat as cs

DEMO = pathlib.Path(os.environ["CHAINSPLAT_ASSETS"]) / "demo_free_30"
NODE = pathlib.Path(__file__).parent.parent.parent / "examples/ros2/rope_follower.py"
logging.getLogger("chainsplat").setLevel(logging.ERROR)


def message(type_name, /, **fields):
    """A message type: fields with a type that makes their first value, and no others."""
    def init(self):
        for field, make in fields.items():
            object.__setattr__(self, field, make())

    def guard(self, field, value):
        if field not in fields:
            raise AttributeError(f"{type_name} has no {field}")
        object.__setattr__(self, field, value)

    def same(self, other):
        return all(getattr(self, field) == getattr(other, field) for field in fields)

    return type(type_name, (), {"__init__": init, "__setattr__": guard, "__eq__": same, "__hash__": None})


Time = message("Time", sec=int, nanosec=int)
Header = message("Header", stamp=Time, frame_id=str)
Vector3 = message("Vector3", x=float, y=float, z=float)
Quaternion = message("Quaternion", x=float, y=float, z=float, w=float)
Pose = message("Pose", position=Vector3, orientation=Quaternion)
PoseStamped = message("PoseStamped", header=Header, pose=Pose)
Transform = message("Transform", translation=Vector3, rotation=Quaternion)
TransformStamped = message("TransformStamped", header=Header, child_frame_id=str, transform=Transform)
Wrench = message("Wrench", force=Vector3, torque=Vector3)
WrenchStamped = message("WrenchStamped", header=Header, wrench=Wrench)
Image = message("Image", header=Header, height=int, width=int, encoding=str, is_bigendian=int, step=int, data=bytes)
JointState = message("JointState", header=Header, name=list, position=list, velocity=list, effort=list)


class Node:
    parameters = {}

    def __init__(self, name):
        self.published, self.callbacks = {}, {}

    def declare_parameter(self, name, default):
        return types.SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind, topic, depth):
        self.published[topic] = []
        return types.SimpleNamespace(publish=self.published[topic].append)

    def create_subscription(self, kind, topic, callback, depth):
        self.callbacks[topic] = callback

    def get_logger(self):
        return logging.getLogger("node")


class TransformBroadcaster:
    def __init__(self, node):
        self.node = node
        node.published["tf"] = []

    def sendTransform(self, transforms):
        self.node.published["tf"].append(transforms)


def module(name, /, **names):
    made = types.ModuleType(name)
    vars(made).update(names)
    sys.modules[name] = made


def load_node():
    module("rclpy", init=lambda: None, spin=lambda node: None)
    module("rclpy.node", Node=Node)
    module("sensor_msgs")
    module("sensor_msgs.msg", Image=Image, JointState=JointState)
    module("geometry_msgs")
    module("geometry_msgs.msg", PoseStamped=PoseStamped, TransformStamped=TransformStamped, WrenchStamped=WrenchStamped)
    module("tf2_ros", TransformBroadcaster=TransformBroadcaster)
    spec = importlib.util.spec_from_file_location("rope_follower", NODE)
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def stamp(time):
    out = Time()
    out.sec, out.nanosec = int(time), round(1e9 * (time - int(time)))
    return out


def image(array, time, encoding, pad=0):
    out = Image()
    out.header.stamp = stamp(time)
    out.height, out.width = array.shape[:2]
    rows = array.reshape(out.height, -1)
    if encoding == "bgr8":
        rows = array[:, :, ::-1].reshape(out.height, -1)
    out.encoding, out.step = encoding, rows.shape[1] + pad
    out.data = np.pad(rows, ((0, 0), (0, pad))).tobytes()
    return out


class Ros(unittest.TestCase):
    def test_the_node_publishes_what_the_module_finds(self):
        ros = load_node()
        with tempfile.TemporaryDirectory() as folder:
            run = pathlib.Path(folder) / "run"
            twin = cs.train(DEMO, run, joints=3, bending="spatial", frames="0:40")
            capture = cs.Capture.load(DEMO, images=True, camera="cam0", last=40)
            Node.parameters = {"run": str(run), "capture": str(DEMO), "camera": "cam0", "masks": True}
            node = ros.RopeFollower()
            times = capture.times[0]
            start = times[0] + 0.0
            reference = cs.Follower(twin, capture.cameras, capture.base.pose(start), start=round(start, 9) - 1 / 30)
            for frame in range(40):
                time = times[frame]
                pose = capture.base.pose(time)
                gripper = PoseStamped()
                gripper.header.stamp = stamp(time)
                p, q = gripper.pose.position, gripper.pose.orientation
                p.x, p.y, p.z = pose[:3, 3]
                q.x, q.y, q.z, q.w = ros.quaternion_of(pose[:3, :3])
                node.callbacks["gripper"](gripper)
                node.callbacks["mask"](image(capture.mask(0, frame), time, "mono8"))
                node.callbacks["image"](image(capture.image(0, frame), time, "bgr8", pad=8))
                found = reference.update(capture.image(0, frame), capture.mask(0, frame), time, base=pose)
            joints = node.published["rope/joints"]
            self.assertEqual(len(joints), 40)
            np.testing.assert_allclose(joints[-1].position, found.theta, atol=1e-5)
            self.assertEqual(joints[-1].name[-1], f"theta_{twin.angles}")
            last = node.published["tf"][-1][-1]
            self.assertEqual(last.child_frame_id, f"rope_link_{twin.links - 1}")
            t = last.transform.translation
            np.testing.assert_allclose([t.x, t.y, t.z], twin.link_poses(found.theta, pose)[-1][:3, 3], atol=1e-5)
            self.assertGreater(len(node.published["rope/force"]), 1)
            self.assertTrue(np.isfinite(node.published["rope/force"][-1].wrench.force.x))
            # twice the same frame: a line, no line of angles
            with self.assertLogs("node", "WARNING"):
                node.callbacks["image"](image(capture.image(0, 39), times[39], "bgr8"))
            self.assertEqual(len(joints), 40)

    def test_rotations_go_through_quaternions(self):
        ros = load_node()
        random = np.random.default_rng(1)
        for _ in range(50):
            q, _ = np.linalg.qr(random.normal(size=(3, 3)))
            rotation = q * np.sign(np.linalg.det(q))
            pose = Pose()
            pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = ros.quaternion_of(rotation)
            np.testing.assert_allclose(ros.matrix_of(pose)[:3, :3], rotation, atol=1e-12)


if __name__ == "__main__":
    unittest.main()
