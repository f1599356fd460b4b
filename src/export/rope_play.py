#!/usr/bin/env python3
"""Plays the rope of an MJCF file that chainsplat has written, in MuJoCo: python3 ROPE_play.py [-o STATES.csv] [--view]

The base follows ROPE_base.csv. Its joints are so heavy that the rope cannot move them; before every step they are set to
the prescribed place and speed and pushed by what their acceleration needs (a weld to a mocap body would lag by a
millimeter, and a base without its acceleration swings the rope by centimeters less). What MJCF has no law for is added as
passive forces: friction spread along links that lie on a table, drag that is proportional to speed, the rope's twist within
its links (with their rolls as states of their own), and dry friction in bending.
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


class Twist:
    """How a rope of universal joints twists within its links: chainsplat's docs/mathematics.md 3.11, in its symbols."""

    LEAST_RETARDATION = 1e-3  # s
    FOLDED, SMOOTH = 0.05, 0.01  # of a joint that is folded back, which has no twist of its own

    def __init__(self, twist, stiffness, damping, rest, angles):
        pairs = [np.reshape(x, (-1, 2)) for x in (stiffness, damping, rest)]
        (self.k, self.d, self.rest), self.c, m = pairs, twist, len(twist)
        self.dc = twist * np.maximum(self.d.sum(1) / self.k.sum(1), self.LEAST_RETARDATION)
        self.by_chi, self.by_tau = (np.eye(m) + np.eye(m, k=-1)) / 2, np.eye(m) - np.eye(m, k=-1)
        self.roll, self.turning = np.zeros(m), np.zeros(m)
        for _ in range(30):  # begins at rest
            forces, slopes = self.elastic(angles)[2:]
            self.roll -= np.linalg.solve(self.over_rolls(*slopes), self.by_chi.T @ forces[0] + self.by_tau.T @ forces[1])

    def over_rolls(self, chi, tau):
        return self.by_chi.T @ (chi[:, None] * self.by_chi) + self.by_tau.T @ (tau[:, None] * self.by_tau)

    def elastic(self, angles):
        """Torques on the angles beside -k (angle - rest), d delta / d angle; dE/d(chi, tau) and their slopes."""
        chi, (ca, cb), (sa, sb) = self.by_chi @ self.roll, np.cos(angles).T, np.sin(angles).T
        (a0, b0), w = self.rest.T, (1 + ca) * (1 + cb) / 4
        fade = self.SMOOTH * np.exp(-w / self.FOLDED)
        q, q_w = 4 * (w + fade), 4 * (1 - fade / self.FOLDED)
        u = sa * sb / q
        a0, b0 = np.cos(chi) * a0 - np.sin(chi) * b0, np.sin(chi) * a0 + np.cos(chi) * b0
        delta = 2 * np.stack([ca * sb + u * q_w * sa * (1 + cb) / 4, sa * cb + u * q_w * (1 + ca) * sb / 4], 1)
        delta /= (q * (1 + u * u))[:, None]
        moment = self.c * (self.by_tau @ self.roll + 2 * np.arctan(u))
        x, y = (angles - np.stack([a0, b0], 1)).T
        (ka, kb) = self.k.T
        torque = self.k * (np.stack([a0, b0], 1) - self.rest) - moment[:, None] * delta
        return (torque, delta, (ka * x * b0 - kb * y * a0, moment),
                (ka * (x * a0 + b0 * b0) + kb * (y * b0 + a0 * a0), self.c))

    def torque(self, angles, rates):
        torque, delta, forces, _ = self.elastic(angles)
        (a, b), (va, vb), (da, db) = angles.T, rates.T, self.d.T
        twisting = np.sum(delta * rates, 1)
        self.turning = -np.linalg.solve(
            self.over_rolls(da * b * b + db * a * a, self.dc),
            self.by_chi.T @ (forces[0] + da * b * va - db * a * vb) + self.by_tau.T @ (forces[1] + self.dc * twisting))
        chi, tau = self.by_chi @ self.turning, self.by_tau @ self.turning + twisting
        return torque - np.stack([da * chi * b, -db * chi * a], 1) - (self.dc * tau)[:, None] * delta

    def advance(self, seconds):
        self.roll = self.roll + seconds * self.turning


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
        mujoco.mj_resetDataKeyframe(m, self.data, 0)
        self.data.time = self.start
        self.twist = self.slip = None
        if "torsional_stiffness" in n:
            self.twist = Twist(n["torsional_stiffness"], m.jnt_stiffness[4:], m.dof_damping[6:], m.qpos_spring[7:],
                               self.data.qpos[7:].reshape(-1, 2))
        if "bending_friction" in n:
            self.slip, self.slip_moment, self.slip_angle = n["friction_state"].copy(), n["bending_friction"], n["bending_friction_angle"]
            bends = np.abs(m.jnt_axis[4:] @ self.direction) < 0.5
            self.with_slip = bends * (np.equal.outer(self.child, self.child) & bends)  # bending angles of one joint
        if self.normal is not None or self.linear.any() or self.twist or self.slip is not None:
            mujoco.set_mjcb_passive(self.passive)

    def passive(self, m, d):
        if m.nv != self.model.nv:
            return
        if self.twist:
            d.qfrc_passive[6:] += self.twist.torque(d.qpos[7:].reshape(-1, 2), d.qvel[6:].reshape(-1, 2)).ravel()
        if self.slip is not None:
            d.qfrc_passive[6:] -= self.slip_moment * self.slip
        if self.normal is None and not self.linear.any():
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

    def remember(self, seconds):
        """What the rope remembers goes on by a step: its rolls, and the shares of friction in bending (Dahl's law)."""
        if self.twist:
            self.twist.advance(seconds)
        if self.slip is not None:
            rate = self.data.qvel[6:]
            speed = np.sqrt(self.with_slip @ rate**2)
            ahead = np.divide(rate, speed, out=np.zeros_like(rate), where=speed > 0)
            self.slip = ahead + (self.slip - ahead) * np.exp(-speed * seconds / self.slip_angle)

    def advance(self, time):
        """Steps up to `time`, s, and returns the joint angles, rad."""
        steps = max(0, round((time - self.data.time) / self.model.opt.timestep))
        for _ in range(steps):
            self.set_base(self.data.time)
            mujoco.mj_step(self.model, self.data)
            self.remember(self.model.opt.timestep)
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
