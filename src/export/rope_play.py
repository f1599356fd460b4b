#!/usr/bin/env python3
"""Plays the rope of an MJCF file that chainsplat has written, in MuJoCo: python3 ROPE_play.py [-o STATES.csv] [--view]

The base follows ROPE_base.csv. Its joints are so heavy that the rope cannot move them; before every step they are set to
the prescribed place and speed and pushed by what their acceleration needs (a weld to a mocap body would lag by a
millimeter, and a base without its acceleration swings the rope by centimeters less). What MJCF has no law for, friction
spread along links that lie on a table, and drag that is proportional to speed, is added as passive forces.
"""
import argparse
import pathlib

import mujoco
import numpy as np

POINTS, WEIGHTS = (1 + np.sqrt(0.6) * np.array([-1, 0, 1])) / 2, np.array([5, 8, 5]) / 18  # Gauss, along a link


def cross(a, b):  # faster than NumPy's for three numbers
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class Base:
    """Its motion between the rows of the table: columns time, p 3, v 3, a 3 (world), q 4 (wxyz), w 3, dw 3 (base frame)."""

    def __init__(self, file):
        self.table = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)
        q, w = self.table[:, 10:14], self.table[:, 14:17]
        s, v = q[:, :1], q[:, 1:]  # dq/dt = q (0, w) / 2
        self.dq = 0.5 * np.hstack([-np.sum(v * w, 1, keepdims=True), s * w + np.cross(v, w)])

    def at(self, time):
        t, k = self.table[:, 0], 0
        if len(t) > 1:
            k = int(np.clip(np.searchsorted(t, time, "right") - 1, 0, len(t) - 2))
        a, b = self.table[k], self.table[min(k + 1, len(t) - 1)]
        h = max(b[0] - a[0], 1e-12)
        u = float(np.clip((time - a[0]) / h, 0, 1))

        def cubic(i, j, dy0, dy1):  # columns i..j by values and slopes at both ends
            return ((1 + 2 * u) * (1 - u) ** 2 * a[i:j] + u * (1 - u) ** 2 * h * dy0 + u * u * (3 - 2 * u) * b[i:j]
                    - u * u * (1 - u) * h * dy1)
        q = cubic(10, 14, self.dq[k], self.dq[min(k + 1, len(t) - 1)])
        return (np.r_[cubic(1, 4, a[4:7], b[4:7]), q / np.linalg.norm(q)],
                np.r_[cubic(4, 7, a[7:10], b[7:10]), cubic(14, 17, a[17:20], b[17:20])],
                (1 - u) * np.r_[a[7:10], a[17:20]] + u * np.r_[b[7:10], b[17:20]])


class Rope:
    def __init__(self, file):
        self.model = m = mujoco.MjModel.from_xml_path(str(file))
        self.data = mujoco.MjData(m)
        self.base = Base(pathlib.Path(file).with_name(pathlib.Path(file).stem + "_base.csv"))
        n = {m.numeric(i).name: m.numeric(i).data for i in range(m.nnumeric)}
        self.start, self.heavy = n["start_time"][0], np.r_[m.dof_armature[:6]]
        self.direction, self.across = n["direction"], n.get("bending_axis")
        self.length, self.linear = n["link_length"], n["air_linear"]
        self.viscous, self.coulomb = n.get("viscous_friction"), n.get("coulomb_force")
        self.normal, self.speed, self.lever = n.get("table_normal"), n.get("coulomb_speed"), n.get("roll_lever")
        self.links = [m.body(f"link_{j + 1}").id for j in range(len(self.length))]
        self.child = [self.links.index(m.jnt_bodyid[1 + 3 + k]) for k in range(m.njnt - 4)]
        ends = np.cumsum(self.length) + n["first_joint"][0]
        self.share = np.minimum((ends - self.length)[self.child][:, None], (ends - self.length / 2)[None]) / ends[-1]
        if self.normal is not None or self.linear.any():
            mujoco.set_mjcb_passive(self.passive)
        mujoco.mj_resetDataKeyframe(m, self.data, 0)
        self.data.time = self.start

    def passive(self, m, d):
        if m.nv != self.model.nv:
            return
        twist, sums = np.zeros(6), np.zeros(len(self.links))
        for j, body in enumerate(self.links):
            mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
            frame = d.xmat[body].reshape(3, 3)
            along, places = frame @ self.direction, POINTS * self.length[j]
            v = twist[3:] + np.outer(places, cross(twist[:3], along))
            force = -self.linear[j] * (v - np.outer(v @ along, along))
            if self.normal is not None:
                slip = v - np.outer(v @ self.normal, self.normal)
                rate = self.viscous[j] + self.coulomb[j] / np.sqrt(np.sum(slip**2, 1) + self.speed[0] ** 2)
                force -= rate[:, None] * slip
                if self.lever is not None:
                    sums[j] = -WEIGHTS @ (rate * (slip @ cross(frame @ self.across, along)))
            moment = cross(along, (WEIGHTS * places) @ force)  # about the body's origin
            mujoco.mj_applyFT(m, d, WEIGHTS @ force, moment, d.xpos[body], body, d.qfrc_passive)
        if self.lever is not None:  # friction under a curved rope rolls it, which turns its curvature into the plane
            d.qfrc_passive[6:] -= self.lever * (self.share @ sums)

    def set_base(self, time):
        place, speed, acceleration = self.base.at(time)
        self.data.qpos[:7], self.data.qvel[:6] = place, speed
        self.data.qfrc_applied[:6] = self.heavy * acceleration

    def advance(self, time):
        """Steps up to `time`, s, and returns the joint angles, rad."""
        steps = max(0, round((time - self.data.time) / self.model.opt.timestep))
        for _ in range(steps):
            self.set_base(self.data.time)
            mujoco.mj_step(self.model, self.data)
        self.set_base(self.data.time)
        mujoco.mj_forward(self.model, self.data)
        return self.data.qpos[7:].copy()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", default=str(pathlib.Path(__file__)).replace("_play.py", ".xml"))
    parser.add_argument("-o", "--output", help="states to write, as chainsplat's rollout")
    parser.add_argument("--rate", type=float, default=30.0, help="rows a second")
    parser.add_argument("--view", action="store_true", help="show it in MuJoCo's viewer")
    asked = parser.parse_args()
    rope = Rope(asked.file)
    end = rope.base.table[-1, 0]
    if asked.view:
        import mujoco.viewer
        with mujoco.viewer.launch_passive(rope.model, rope.data) as viewer:
            while viewer.is_running() and rope.data.time < end:
                rope.advance(rope.data.time + 1 / asked.rate)
                viewer.sync()
        return
    rows = []
    for k in range(int((end - rope.start) * asked.rate + 1e-6) + 1):
        time = rope.start + k / asked.rate
        rows.append([time, *rope.advance(time)])
    names = "time," + ",".join(f"theta_{k + 1}" for k in range(len(rows[0]) - 1))
    np.savetxt(asked.output or "/dev/stdout", rows, "%.9g", ",", header=names, comments="")


if __name__ == "__main__":
    main()
