#!/bin/bash
# Exports for NumPy and MuJoCo, run as their readers run them: twin.py poses the links as the program does, and MuJoCo moves the
# rope as the rollout does. $1: the program, $2: test_export, which makes the files. Python is $CHAINSPLAT_PYTHON, else python3;
# without NumPy all is skipped (77), without MuJoCo its part.
. "$(dirname "$0")/lib.sh"
python=${CHAINSPLAT_PYTHON:-python3}
if ! "$python" -c 'import numpy' 2>/dev/null; then
  echo 'skipped: python3 has no numpy (CHAINSPLAT_PYTHON names another one)'
  exit 77
fi
CHAINSPLAT_TEST_EXPORTS=$work/made "$2" --test-case='exports for NumPy*' >"$work/stderr" 2>&1 || fail 'test_export makes no files'

poses() {  # free, table or twisting
  (cd "$work/made/$1" && "$python" - <<'PYTHON') || fail "$1: twin.py or the arrays are wrong"
import numpy as np
from twin import Twin
t = Twin('twin.npz')
for prefix in '', 'rollout_':
    theta, base, poses = (getattr(t, prefix + name) for name in ('theta', 'base_pose', 'link_pose'))
    worst = max(abs(t.link_poses(a, b) - p).max() for a, b, p in zip(theta, base, poses))
    print(f'{prefix}link poses: {worst:.1e}')
    assert worst < 1e-12 and len(poses) == len(getattr(t, prefix + 'time')), worst
line = np.loadtxt('centerline.csv', delimiter=',', skiprows=1)[:, 1:].reshape(len(t.rollout_time), -1, 3)
mine = np.array([t.centerline(a, b, 31) for a, b in zip(t.rollout_theta, t.rollout_base_pose)])
assert abs(mine[:, [0, -1]] - line[:, [0, -1]]).max() < 1e-9
states = np.loadtxt('rollout.csv', delimiter=',', skiprows=1)
angles = len(t.axes)
assert (states == np.hstack([t.rollout_time[:, None], t.rollout_theta, t.rollout_thetadot])).all()
assert t.theta_covariance.shape == (len(t.time), angles, angles) and list(t.estimate_names) == ['log_stiffness', 'log_damping']
assert np.allclose(t.gaussian_link_probability.sum(1), 1) and np.allclose(np.linalg.norm(t.gaussian_rotation, axis=1), 1, atol=1e-6)
centers = t.gaussian_centers(t.theta[0], t.base_pose[0])
near = np.linalg.norm(centers[:, None] - t.centerline(t.theta[0], t.base_pose[0], 301)[None], axis=2).min(1)
assert near.max() < t.diameter, near.max()
PYTHON
}
poses free
poses table
poses twisting

if "$python" -c 'import mujoco' 2>/dev/null; then
  moves() {  # free, table or twisting; degrees
    (cd "$work/made/$1" && "$python" rope_play.py -o played.csv && "$python" - "$2" <<'PYTHON') || fail "$1: MuJoCo moves it otherwise"
import sys
import numpy as np
played, ours = (np.loadtxt(name, delimiter=',', skiprows=1) for name in ('played.csv', 'rollout.csv'))
angles = played.shape[1] - 1
assert played.shape[0] == ours.shape[0] and abs(played[:, 0] - ours[:, 0]).max() < 1e-6
error = np.degrees(played[:, 1:] - ours[:, 1:1 + angles])
print(f'{np.sqrt((error**2).mean()):.4f} degrees RMS, worst {abs(error).max():.4f}, of {np.degrees(ours[:, 1:1 + angles].std()):.1f}')
assert np.sqrt((error**2).mean()) <= float(sys.argv[1])
PYTHON
  }
  moves free 0.01
  moves twisting 0.02
  moves table 0.02
else
  echo "MuJoCo is not compared: $python has no mujoco"
fi
finish
