#!/usr/bin/env python3
"""A ROS 2 node that follows a rope: images and the gripper's pose in; joint angles, link transforms and the force out.

    python3 rope_follower.py --ros-args -p run:=RUN -p capture:=CAPTURE -p camera:=cam0

It needs rclpy, sensor_msgs, geometry_msgs and tf2_ros of a ROS 2 installation and the Python module chainsplat, nothing else. The
camera is the one of a capture (its calibration and pose, as the twin knows it); images are rgb8 or bgr8.

  in   image        sensor_msgs/Image           as recorded
       mask         sensor_msgs/Image, mono8    of the same stamp; only where the parameter masks is true
       gripper      geometry_msgs/PoseStamped   the base in the world, at least as often as images
  out  rope/joints  sensor_msgs/JointState      theta_1.., rad; velocity rad/s; effort: standard deviation, rad
       rope/force   geometry_msgs/WrenchStamped the force from outside, N, world; a moment of r x F about the world's origin
       tf           world -> rope_link_0..      where the links begin

Angles come with the image's stamp. A frame whose gripper pose is older than 50 ms is passed over.
"""
import collections

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped, WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState
from tf2_ros import TransformBroadcaster

import chainsplat as cs

OLDEST_POSE = 0.05  # s
FORCE_WINDOW, FORCE_EVERY, FORCE_LAG = 24, 6, 2  # states that a force is found from; of them; behind the last


def seconds(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


def array_of(message):
    channels = 1 if message.encoding == "mono8" else 3
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    image = rows[:, :message.width * channels].reshape(message.height, message.width, channels)
    if message.encoding == "bgr8":
        image = image[:, :, ::-1]
    return image if channels == 3 else image[:, :, 0]


def matrix_of(pose):
    q, p = pose.orientation, pose.position
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / np.linalg.norm([q.x, q.y, q.z, q.w])
    out = np.eye(4)
    out[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                   [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                   [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    out[:3, 3] = [p.x, p.y, p.z]
    return out


def quaternion_of(r):
    """x, y, z, w of a rotation, by the largest of the four."""
    squares = np.array([1 + r[0, 0] - r[1, 1] - r[2, 2], 1 - r[0, 0] + r[1, 1] - r[2, 2],
                        1 - r[0, 0] - r[1, 1] + r[2, 2], 1 + r[0, 0] + r[1, 1] + r[2, 2]])
    k = int(np.argmax(squares))
    products = np.array([[squares[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
                         [r[0, 1] + r[1, 0], squares[1], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
                         [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[2], r[1, 0] - r[0, 1]],
                         [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]]])
    return products[k] / (2 * np.sqrt(squares[k]))


class RopeFollower(Node):
    def __init__(self):
        super().__init__("rope_follower")
        run, capture, camera = (self.declare_parameter(name, "").value for name in ("run", "capture", "camera"))
        self.masked = self.declare_parameter("masks", False).value
        self.twin = cs.Twin.load(run)
        cameras = cs.Capture.load(capture, camera=camera).cameras
        self.cameras = cameras[:1]
        self.follower = None  # from the first pose on
        self.pose = None      # (time, 4 x 4), the last
        self.masks = collections.deque(maxlen=8)
        self.history = collections.deque(maxlen=FORCE_WINDOW)  # (time, theta, thetadot, pose)
        self.frames = 0
        self.joints = self.create_publisher(JointState, "rope/joints", 10)
        self.force = self.create_publisher(WrenchStamped, "rope/force", 10)
        self.transforms = TransformBroadcaster(self)
        self.create_subscription(PoseStamped, "gripper", self.on_pose, 50)
        if self.masked:
            self.create_subscription(Image, "mask", self.masks.append, 10)
        self.create_subscription(Image, "image", self.on_image, 10)

    def on_pose(self, message):
        self.pose = seconds(message.header.stamp), matrix_of(message.pose)
        if self.follower is None:
            self.follower = cs.Follower(self.twin, self.cameras, self.pose[1], start=self.pose[0] - 1 / 30)

    def on_image(self, message):
        time = seconds(message.header.stamp)
        mask = next((m for m in self.masks if m.header.stamp == message.header.stamp), None)
        if self.pose is None or abs(time - self.pose[0]) > OLDEST_POSE or (self.masked and mask is None):
            return
        try:
            found = self.follower.update(array_of(message), array_of(mask) if self.masked else None, time, base=self.pose[1])
        except cs.InputError as error:  # a frame that came twice, or of another size
            self.get_logger().warning(str(error))
            return
        if found.status == "lost":
            self.history.clear()
            self.get_logger().warning("the rope is lost")
            return
        self.publish(message.header.stamp, found)

    def publish(self, stamp, found):
        angles = JointState()
        angles.header.stamp, angles.header.frame_id = stamp, "world"
        angles.name = [f"theta_{k + 1}" for k in range(self.twin.angles)]
        angles.position, angles.velocity = found.theta.tolist(), found.thetadot.tolist()
        if len(found.covariance):
            angles.effort = np.sqrt(np.diag(found.covariance)[:self.twin.angles]).tolist()
        self.joints.publish(angles)
        links = []
        for k, pose in enumerate(self.twin.link_poses(found.theta, self.pose[1])):
            link = TransformStamped()
            link.header.stamp, link.header.frame_id, link.child_frame_id = stamp, "world", f"rope_link_{k}"
            t, r = link.transform.translation, link.transform.rotation
            t.x, t.y, t.z = pose[:3, 3].tolist()
            r.x, r.y, r.z, r.w = quaternion_of(pose[:3, :3]).tolist()
            links.append(link)
        self.transforms.sendTransform(links)
        self.history.append((found.time, found.theta, found.thetadot, self.pose[1]))
        self.frames += 1
        if len(self.history) == FORCE_WINDOW and self.frames % FORCE_EVERY == 0 and found.status == "following":
            self.publish_force(stamp)

    def publish_force(self, stamp):
        times, theta, thetadot, poses = map(np.array, zip(*self.history))
        forces = self.twin.forces(cs.States(times, theta, thetadot), cs.Trajectory(times, poses))
        at = len(times) - 1 - FORCE_LAG  # the last ones have accelerations of one side only
        point, force = forces["point"][at], forces["force"][at]
        wrench = WrenchStamped()
        wrench.header.stamp, wrench.header.frame_id = stamp, "world"
        f, m = wrench.wrench.force, wrench.wrench.torque
        f.x, f.y, f.z = force.tolist()
        m.x, m.y, m.z = np.cross(point, force).tolist()
        self.force.publish(wrench)


def main():
    rclpy.init()
    rclpy.spin(RopeFollower())


if __name__ == "__main__":
    main()
