"""A prediction with its band: prediction_band.py RUN [MOTION.tum] - where the tip will be, and how sure that is.

The band is what identification leaves open: the rope is rolled out with parameters drawn from their covariance.
"""
import sys

import numpy as np

import chainsplat as cs

twin = cs.Twin.load(sys.argv[1])
base = cs.Trajectory.read(sys.argv[2]) if len(sys.argv) > 2 else None
band = twin.rollout_batch(twin.sample(100, seed=1), bases=[base] if base else None, rate=10)
best = twin.rollout(base, times=band["time"])


def tip(theta, time):
    return twin.centerline(theta, (base or twin.base).pose(time), count=2)[-1]


print("time      x         y         z         +- (95 %), m")
for k, time in enumerate(band["time"]):
    spread = np.array([tip(theta[k], time) for theta in band["theta"] if np.isfinite(theta[k]).all()])
    x, y, z = tip(best.theta[k], time)
    print(f"{time:5.2f} {x:9.4f} {y:9.4f} {z:9.4f} {1.96 * np.sqrt(spread.var(0).sum()):9.5f}")
