"""Poses a twin that chainsplat has exported as .npz, in pure NumPy:

    twin = Twin("twin.npz")
    poses = twin.link_poses(twin.theta[0], twin.base_pose[0])    # links x 4 x 4: link frames in the world
    line = twin.centerline(twin.theta[0], twin.base_pose[0], 50)  # 50 x 3

Units are m, s, kg, N and rad. docs/formats.md 5.5 of chainsplat lists all arrays; every one is an attribute here.
"""
import numpy as np


class Twin:
    def __init__(self, file):
        self.__dict__.update(np.load(file))

    def link_motions(self, theta, base_pose):
        """4 x 4 world motions of the links, base link first: they carry what is given in the home configuration."""
        motions = [np.array(base_pose)] + [None] * int(self.child_link[-1])
        for axis, child, angle in zip(self.axes, self.child_link, theta):
            w, v = axis[:3], axis[3:]
            k = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
            turn = np.eye(4)
            turn[:3, :3] += np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
            turn[:3, 3] = (np.eye(3) - turn[:3, :3]) @ np.cross(w, v)  # w x v is a point of the axis
            before = motions[child - 1] if motions[child] is None else motions[child]
            motions[child] = before @ turn
        motions = np.array(motions)
        if hasattr(self, "link_lift"):
            motions[:, :3, 3] += (motions[:, :3, :3] @ self.bending_axis) * self.link_lift[:, None]
        return motions

    def link_poses(self, theta, base_pose):
        """4 x 4 world poses of the link frames: origin at the link's joint, axes parallel to the base's at home."""
        home = np.tile(np.eye(4), (len(self.link_start), 1, 1))
        home[:, :3, 3] = self.link_start[:, None] * self.direction
        return self.link_motions(theta, base_pose) @ home

    def centerline(self, theta, base_pose, count):
        arclength = np.linspace(0, self.length, count)
        link = np.searchsorted(self.link_start[1:], arclength, "right")
        return self.carry(link, arclength[:, None] * self.direction, theta, base_pose)

    def gaussian_centers(self, theta, base_pose, roll=None):
        """Of every Gaussian on its most probable link, in the world; roll: how far the material is turned in each link."""
        link = self.gaussian_link_probability.argmax(1)
        return self.carry(link, self.rolled(link, roll), theta, base_pose)

    def gaussian_brightness(self, theta, base_pose, roll=None):
        """By which every Gaussian's color, 0.5 + SH, is multiplied: what the light that stays in the world does to it."""
        if not hasattr(self, "light_linear"):
            return np.ones(len(self.gaussian_mean))
        link = self.gaussian_link_probability.argmax(1)
        home = self.rolled(link, roll)
        home = home - (home @ self.direction)[:, None] * self.direction
        normal = self.carry(link, home, theta, base_pose) - self.carry(link, 0 * home, theta, base_pose)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        squares = np.einsum("ni,ij,nj->n", normal, self.light_quadratic, normal)
        return np.maximum(self.light_least, self.light_constant + normal @ self.light_linear + squares)

    def rolled(self, link, roll):
        mean = self.gaussian_mean
        if roll is None:
            return mean
        along = (mean @ self.direction)[:, None] * self.direction
        cosine, sine = np.cos(roll[link])[:, None], np.sin(roll[link])[:, None]
        return along + cosine * (mean - along) + sine * np.cross(self.direction, mean)

    def carry(self, link, home, theta, base_pose):
        motion = self.link_motions(theta, base_pose)[link]
        return np.einsum("nij,nj->ni", motion[:, :3, :3], home) + motion[:, :3, 3]
