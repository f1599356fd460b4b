"""A comparison with MuJoCo: mujoco_comparison.py RUN BASE.tum PICTURE - one base motion, simulated by the twin and by MuJoCo.

MuJoCo gets the exported model and plays it with the player that is written beside it. The centerlines in the picture are
where each of the two has the rope: the twin's wide and orange, MuJoCo's thin and black on it.
"""
import pathlib
import sys
import tempfile

import numpy as np

import chainsplat as cs

try:
    import mujoco  # for the player
except ImportError:
    sys.exit("mujoco_comparison.py: this Python has no module mujoco; install it: python3 -m pip install mujoco")

run, motion, picture = sys.argv[1:]
twin = cs.Twin.load(run)
base = cs.Trajectory.read(motion)
with tempfile.TemporaryDirectory() as folder:
    twin.export(pathlib.Path(folder) / "rope.xml", base=base)
    sys.path.insert(0, folder)
    from rope_play import Rope
    rope = Rope(pathlib.Path(folder) / "rope.xml")
states = twin.rollout(base, times=np.arange(rope.start, base.end + 1e-6, 1 / 30))


def mujocos_centerline(count):
    """From MuJoCo's own bodies: every link is straight, from where its body begins to where the next one does."""
    links = [rope.data.body(f"link_{j}") for j in range(1, twin.links)]
    tip = links[-1].xpos + rope.length[-1] * links[-1].xmat.reshape(3, 3) @ rope.direction
    corners = np.array([rope.data.qpos[:3], *(link.xpos for link in links), tip])
    ends = twin.length - np.r_[rope.length.sum(), rope.length.sum() - np.cumsum(rope.length)]
    return np.stack([np.interp(np.linspace(0, twin.length, count), np.r_[0, ends], x) for x in corners.T], 1)


theta, theirs = zip(*((rope.advance(time), mujocos_centerline(201)) for time in states.time))
ours = np.array([twin.centerline(a, base.pose(time), 201) for a, time in zip(states.theta, states.time)])
angles = np.degrees(np.array(theta) - states.theta)
apart = 1e3 * np.linalg.norm(np.array(theirs) - ours, axis=2)
print(f"{len(states)} states: angles {np.sqrt((angles**2).mean()):.4f} degrees RMS apart, centerline "
      f"{np.sqrt((apart**2).mean()):.3f} mm RMS, {apart.max():.3f} mm at most: {picture}")

# seen from where most of the motion shows: a hanging rope from the side, one on a table from above
level = np.linalg.svd(ours[..., :2].reshape(-1, 2) - ours[..., :2].mean((0, 1)), full_matrices=False)[2]
view = np.array([[*level[0], 0], [*level[1], 0] if twin.tabletop else [0, 0, 1]])
low, high = (ours @ view.T).min((0, 1)), (ours @ view.T).max((0, 1))
scale, margin = 400 / max(high - low), 25  # pixels per meter; pixels
width, height = (scale * (high - low) + 2 * margin).astype(int)
panels = []
for k in np.linspace(0, len(states) - 1, 4).astype(int):
    panel = np.full((height, width, 3), 255, np.uint8)
    for line, half, color in (ours[k], 4, (255, 150, 40)), (theirs[k], 1, (0, 0, 0)):
        for x, y in (margin + scale * (line @ view.T - low)).astype(int):
            panel[max(height - y - half, 0):height - y + half + 1, max(x - half, 0):x + half + 1] = color
    panels.append(panel)
cs.write_png(picture, np.hstack(panels))
