"""A planned hit: planned_hit.py RUN X,Y,Z MOTION.tum - a base motion that brings the tip to a point, m, world.

The plan is made for the identified rope; how it fares with ropes that identification cannot tell from it is printed too.
"""
import sys

import numpy as np

import chainsplat as cs

run, target, out = sys.argv[1:]
twin = cs.Twin.load(run)
target = np.array([float(x) for x in target.split(",")])
plan = cs.plan(twin, target, horizon=2.0)
if not plan.reached:
    sys.exit(f"not reached: {plan.reason}; the nearest motion misses by {1e3 * plan.misses[0]:.1f} mm")
base = plan.base()
base.write(out)
print(f"hits at {plan.times[0]:.2f} s, {1e3 * plan.misses[0]:.2f} mm off: {out}")

batch = twin.rollout_batch(twin.sample(50), bases=[base], times=np.linspace(0.0, plan.duration, 201))
poses = [base.pose(time) for time in batch["time"]]
misses = [min(np.linalg.norm(twin.centerline(theta, pose, count=2)[-1] - target) for theta, pose in zip(rope, poses))
          for rope in batch["theta"]]
print(f"other ropes that it may be: {1e3 * np.median(misses):.2f} mm, one in ten above {1e3 * np.quantile(misses, 0.9):.2f} mm")
