#!/bin/bash
# Exports for NumPy, OpenUSD and MuJoCo, run as their readers run them: twin.py and OpenUSD pose the links as the program does,
# MuJoCo moves the rope as the rollout does and reads the same links and inertia from the URDF. $1: the program, $2: test_export,
# which makes the files. Python is $CHAINSPLAT_PYTHON, else python3; without NumPy all is skipped (77), without OpenUSD (package
# usd-core) or MuJoCo its part.
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

if "$python" -c 'import pxr' 2>/dev/null; then
  usd() {  # free, table or twisting
    (cd "$work/made/$1" && "$python" - <<'PYTHON') || fail "$1: OpenUSD reads another motion"
import numpy as np
from pxr import Usd, UsdGeom
from twin import Twin
t = Twin('twin.npz')
stage = Usd.Stage.Open('rope.usda')
assert UsdGeom.GetStageUpAxis(stage) == 'Z' and UsdGeom.GetStageMetersPerUnit(stage) == 1
codes = (t.time - t.time[0]) * stage.GetTimeCodesPerSecond()
assert abs(codes - np.arange(len(codes))).max() < 1e-6
codes = np.arange(len(codes))
assert stage.GetStartTimeCode() == 0 and stage.GetEndTimeCode() == codes[-1]
path, apart = stage.GetDefaultPrim().GetPath(), 0
for j in range(len(t.link_start)):
    path = path.AppendChild(f'link_{j}')
    prim = stage.GetPrimAtPath(path)
    for code, poses in zip(codes, t.link_pose):
        matrix = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(float(code))
        apart = max(apart, abs(np.array(matrix).T - poses[j]).max())
    shape = UsdGeom.Capsule(stage.GetPrimAtPath(path.AppendChild('shape')))
    ends = np.array(shape.ComputeLocalToWorldTransform(float(codes[-1]))).T @ [[0, 0], [0, 0], [-0.5, 0.5], [1, 1]]
    middle = (ends[:, 0] + ends[:, 1])[:3] / 2
    wanted = np.append(t.link_start, t.length)[j:j + 2].mean() - t.link_start[j]
    assert abs(middle - (t.link_pose[-1, j] @ np.append(wanted * t.direction, 1))[:3]).max() < 1e-12
    axis = (ends[:, 1] - ends[:, 0])[:3]
    assert abs(axis - t.link_pose[-1, j, :3, :3] @ t.direction).max() < 1e-7
    assert np.allclose(UsdGeom.Boundable.ComputeExtentFromPlugins(shape, 0), shape.GetExtentAttr().Get())
print(f'USD: links {apart:.1e}')
try:  # what usdchecker runs, from OpenUSD 25 on
    from pxr import UsdValidation
    found = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators()).Validate(stage)
    assert not found, [each.GetMessage() for each in found]
except ImportError:
    pass
assert apart < 1e-8  # OpenUSD takes turns by less than that for none
PYTHON
  }
  usd free
  usd table
  usd twisting
else
  echo "USD is not read: $python has no pxr"
fi

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
  urdf() {  # free, table, twisting or thin
    (cd "$work/made/$1" && "$python" - <<'PYTHON') || fail "$1: MuJoCo reads another rope from the URDF"
import re
import mujoco
import numpy as np
from twin import Twin
t = Twin('twin.npz')
def read(name):  # the model, its data, and the numbers of the joints' places and rates
    model = mujoco.MjModel.from_xml_path(name)
    joints = [model.joint(f'theta_{k + 1}') for k in range(len(t.axes))]
    return model, mujoco.MjData(model), [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]
def mass(model, data, rates):
    full = np.zeros((model.nv, model.nv))
    if hasattr(data, 'qM'):
        mujoco.mj_fullM(model, full, data.qM)
    else:
        mujoco.mj_fullM(model, data, full)
    return full[np.ix_(rates, rates)]
ours, other = read('rope.urdf'), read('rope.xml')
links = len(t.link_start)
assert ours[0].nv == len(t.axes) and ours[0].nbody == 2 + len(t.axes)
assert np.isclose(ours[0].body_mass.sum(), t.link_mass.sum() + t.tip_mass, rtol=1e-12)
assert np.allclose(ours[0].opt.gravity, other[0].opt.gravity, atol=0)
for (model, _, _, rates), name in ((ours, 'urdf'), (other, 'xml')):
    assert (model.dof_damping[rates] == t.damping).all(), name
assert (ours[0].dof_frictionloss[ours[3]] == getattr(t, 'bending_friction', 0)).all()
rng = np.random.default_rng(4)
apart = heavier = 0
for _ in range(20):
    theta = rng.uniform(-1.2, 1.2, len(t.axes))
    for model, data, places, _ in ours, other:
        data.qpos[places] = theta
        mujoco.mj_forward(model, data)
    data = ours[1]
    assert data.ncon == 0
    for j, pose in enumerate(t.link_poses(theta, np.eye(4))):
        body = data.body(f'link_{j}')
        apart = max(apart, abs(body.xpos - pose[:3, 3]).max(), abs(body.xmat.reshape(3, 3) - pose[:3, :3]).max())
    mine, his = mass(*ours[:2], ours[3]), mass(*other[:2], other[3])
    own = np.sqrt(np.diag(his))
    heavier = max(heavier, abs((mine - his) / np.outer(own, own)).max())
print(f'URDF: links {apart:.1e}, mass matrix {heavier:.1e}')
assert apart < 1e-12 and heavier < 1e-5

# as stiff as its head says it moves as the MJCF does, the base at rest and no air
def row(name):
    return np.array(re.search(name + '.*: (.*)', open('rope.urdf').read())[1].split(), float)
other[0].opt.density = 0
ours[0].opt.timestep, ours[0].opt.integrator = other[0].opt.timestep, other[0].opt.integrator
ours[0].dof_frictionloss[:] = 0
ours[0].jnt_stiffness[:], ours[0].qpos_spring[:] = row('stiffness of the joints'), row('angles at rest')
for _, data, places, rates in ours, other:
    data.qpos[places], data.qvel[rates] = row('angles there'), row('rates there')
for _ in range(int(1 / ours[0].opt.timestep)):
    other[1].qpos[:7], other[1].qvel[:6] = (0, 0, 0, 1, 0, 0, 0), 0
    for model, data, _, _ in ours, other:
        mujoco.mj_step(model, data)
theirs = other[1].qpos[other[2]]
print(f'URDF: {np.degrees(abs(ours[1].qpos - theirs).max()):.1e} degrees after 1 s of {np.degrees(abs(theirs).max()):.1f}')
assert abs(ours[1].qpos - theirs).max() < 1e-4
PYTHON
  }
  urdf free
  urdf table
  urdf twisting
  urdf thin
  moves free 0.01
  moves thin 0.01
  moves twisting 0.02
  moves table 0.02
else
  echo "MuJoCo is not compared: $python has no mujoco"
fi
finish
