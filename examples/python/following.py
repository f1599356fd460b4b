"""Following: following.py RUN CAPTURE - the rope frame by frame, as a camera and a robot would give it.

Frames and poses come from a recording here; in a robot's program they come from its driver. Nothing else changes.
"""
import sys

import chainsplat as cs

run, folder = sys.argv[1:]
twin = cs.Twin.load(run)
capture = cs.Capture.load(folder, images=True, camera=cs.Capture.load(folder).cameras[0].name)
times = capture.times[0]
follower = cs.Follower(twin, capture.cameras, capture.base.pose(times[0]), start=times[0] - 1 / 30)
for frame, time in enumerate(times):
    pose = capture.base.pose(time)
    found = follower.update(capture.image(0, frame), capture.mask(0, frame), time, base=pose)
    x, y, z = twin.centerline(found.theta, pose, count=2)[-1]
    print(f"{time:6.3f} {found.status:10} tip {x:8.4f} {y:8.4f} {z:8.4f} +- {1e3 * found.centerline_sigma:.2f} mm, "
          f"overlap {found.iou:.3f}")
