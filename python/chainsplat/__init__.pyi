import os
from typing import Callable, Dict, List, Optional, Sequence, Tuple, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

__version__: str
__all__: List[str]

_Path = Union[str, os.PathLike]
_Numbers = NDArray[np.float64]
_State = Tuple[ArrayLike, ArrayLike]
_Progress = Callable[[str, int, int, float], object]

class Error(Exception):
    where: str
    what: str
    how: str

class InputError(Error, ValueError): ...
class WorkError(Error, RuntimeError): ...

class Trajectory:
    def __init__(self, time: ArrayLike, poses: ArrayLike) -> None: ...
    @staticmethod
    def read(file: _Path) -> Trajectory: ...
    def write(self, file: _Path) -> None: ...
    def pose(self, time: float) -> _Numbers: ...
    def motion(self, time: float) -> Tuple[_Numbers, _Numbers, _Numbers]: ...
    start: float
    end: float

class Camera:
    def __init__(self, name: str, width: int, height: int, fx: float, fy: float, cx: float, cy: float,
                 world_from_camera: ArrayLike, distortion: Sequence[float] = ...) -> None: ...
    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: List[float]
    readout: float
    world_from_camera: _Numbers
    def project(self, points: ArrayLike) -> _Numbers: ...

class Recording:
    def __init__(self, document: str, base: Trajectory, images: Sequence[ArrayLike], masks: Sequence[ArrayLike],
                 times: Sequence[ArrayLike]) -> None: ...

class Capture:
    @staticmethod
    def load(folder: _Path, images: bool = ..., camera: str = ..., first: int = ..., last: int = ...) -> Capture: ...
    name: str
    tabletop: bool
    length: float
    diameter: float
    cameras: List[Camera]
    base: Trajectory
    times: List[_Numbers]
    def image(self, camera: int, frame: int) -> NDArray[np.uint8]: ...
    def mask(self, camera: int, frame: int) -> NDArray[np.uint8]: ...

class States:
    def __init__(self, time: ArrayLike, theta: ArrayLike, thetadot: Optional[ArrayLike] = ...) -> None: ...
    def __len__(self) -> int: ...
    time: _Numbers
    theta: _Numbers
    thetadot: _Numbers
    roll: _Numbers
    covariance: _Numbers
    def at(self, time: float) -> _Numbers: ...

class Parameters:
    def __init__(self, other: Parameters) -> None: ...
    link_mass: _Numbers
    viscous_friction: _Numbers
    coulomb_friction: _Numbers
    air_linear: _Numbers
    air_quadratic: _Numbers
    stiffness: _Numbers
    rest_angle: _Numbers
    damping: _Numbers
    bending_friction: _Numbers
    bending_friction_angle: _Numbers
    torsional_stiffness: _Numbers
    tip_mass: float
    tip_length: float
    gravity: _Numbers
    substeps: int
    total_mass: float

class Images:
    rgb: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    depth: NDArray[np.float32]

class Twin:
    @staticmethod
    def load(run: _Path, device: str = ...) -> Twin: ...
    def save(self, run: _Path) -> None: ...
    def export(self, file: _Path, states: Optional[States] = ..., base: Optional[Trajectory] = ...,
               mesh: bool = ...) -> None: ...
    angles: int
    links: int
    length: float
    diameter: float
    tabletop: bool
    known_mass: bool
    trusted: bool
    verdict: List[str]
    base: Trajectory
    states: States
    rollout_states: States
    parameters: Parameters
    estimates: Dict[str, object]
    def properties(self) -> Dict[str, Tuple[float, float, str]]: ...
    def cameras(self, cameras: Sequence[Camera]) -> List[Camera]: ...
    def link_poses(self, theta: ArrayLike, base: Optional[ArrayLike] = ...) -> _Numbers: ...
    def centerline(self, theta: ArrayLike, base: Optional[ArrayLike] = ..., count: int = ...) -> _Numbers: ...
    def jacobian(self, theta: ArrayLike, s: float, base: Optional[ArrayLike] = ...) -> _Numbers: ...
    def rest(self, base: Optional[ArrayLike] = ...) -> _Numbers: ...
    def rollout(self, base: Optional[Trajectory] = ..., initial: Optional[_State] = ..., times: Optional[ArrayLike] = ...,
                rate: float = ..., parameters: Optional[Parameters] = ...) -> States: ...
    def rollout_batch(self, parameters: Optional[Sequence[Parameters]] = ...,
                      bases: Optional[Sequence[Trajectory]] = ..., initials: Optional[Sequence[_State]] = ...,
                      times: Optional[ArrayLike] = ..., rate: float = ...) -> Dict[str, _Numbers]: ...
    def rollout_derivatives(self, names: Sequence[str], base: Optional[Trajectory] = ..., initial: Optional[_State] = ...,
                            times: Optional[ArrayLike] = ..., rate: float = ...,
                            directions: Sequence[Trajectory] = ...) -> Dict[str, object]: ...
    def sample(self, count: int, seed: int = ...) -> List[Parameters]: ...
    def render(self, states: States, camera: Camera, base: Optional[Trajectory] = ...,
               times: Optional[ArrayLike] = ..., depth: bool = ..., undistorted: bool = ...) -> Images: ...
    def forces(self, states: States, base: Optional[Trajectory] = ...,
               contact: Optional[ArrayLike] = ...) -> Dict[str, _Numbers]: ...

class Estimate:
    time: float
    theta: _Numbers
    thetadot: _Numbers
    covariance: _Numbers
    base_late: float
    base_late_sigma: float
    theta_by_base_late: _Numbers
    grasp: _Numbers
    settling: bool
    centerline_sigma: float
    iou: float
    residual: float
    surprise: float
    seen: bool
    status: str

class Follower:
    def __init__(self, twin: Twin, cameras: Sequence[Camera], base: Union[None, Trajectory, ArrayLike] = ...,
                 start: float = ..., solver: str = ..., device: str = ..., corrected: bool = ...) -> None: ...
    def update(self, image: ArrayLike, mask: Optional[ArrayLike], time: float,
               base: Optional[ArrayLike] = ...) -> Estimate: ...
    def update_all(self, images: Sequence[ArrayLike], masks: Optional[Sequence[ArrayLike]], time: float,
                   base: Optional[ArrayLike] = ...) -> Estimate: ...

class Plan:
    reached: bool
    reason: str
    misses: _Numbers
    times: _Numbers
    points: _Numbers
    duration: float
    def base(self, rate: float = ...) -> Trajectory: ...
    def states(self, rate: float = ...) -> States: ...
    def json(self) -> str: ...

class Excitation:
    duration: float
    states: States
    parameters: Dict[str, Dict[str, float]]
    gain: float
    repeated_gain: float
    def base(self, rate: float = ...) -> Trajectory: ...

class Workspace:
    def __init__(self) -> None: ...

def train(capture: Union[_Path, Recording], run: _Path, progress: Optional[_Progress] = ..., resume: bool = ..., force: bool = ...,
          picture: _Path = ..., anyway: bool = ..., seed: int = ..., device: str = ..., workspace: Optional[Workspace] = ...,
          **options: object) -> Twin: ...
def identify(runs: Sequence[_Path], joint: bool = ..., markers: Sequence[_Path] = ...,
             progress: Optional[_Progress] = ..., seed: int = ..., device: str = ...) -> None: ...
def evaluate(
    run: _Path, capture: _Path, picture: _Path = ..., device: str = ..., lpips: _Path = ...
) -> Dict[str, Dict[str, float]]: ...
def plan(twin: Twin, targets: ArrayLike, axes: str = ..., horizon: float = ..., free_horizon: bool = ..., hit: str = ...,
         terminal: Optional[ArrayLike] = ..., samples: int = ..., initial: Optional[_State] = ..., seed: int = ...) -> Plan: ...
def excite(twin: Twin, duration: float = ..., axes: str = ..., stroke: float = ..., velocity: float = ...,
           acceleration: float = ..., jerk: float = ..., noise: Optional[float] = ..., frame_rate: float = ...,
           max_bend: float = ..., seed: int = ...) -> Excitation: ...
def set_threads(threads: int) -> None: ...
def write_png(file: _Path, image: ArrayLike) -> None: ...
def recording(*, cameras: Sequence[Camera], images: Sequence[ArrayLike], masks: Sequence[ArrayLike],
              times: Sequence[ArrayLike], base: Trajectory, length: float, diameter: float, direction: ArrayLike,
              bending_axis: ArrayLike, mass: Optional[float] = ..., gravity: ArrayLike = ...,
              table: Optional[Tuple[ArrayLike, ArrayLike]] = ..., name: str = ...) -> Recording: ...
def write_capture(folder: _Path, *, cameras: Sequence[Camera], images: Sequence[ArrayLike], masks: Sequence[ArrayLike],
                  times: Sequence[ArrayLike], base: Trajectory, length: float, diameter: float, direction: ArrayLike,
                  bending_axis: ArrayLike, mass: Optional[float] = ..., gravity: ArrayLike = ...,
                  table: Optional[Tuple[ArrayLike, ArrayLike]] = ..., name: Optional[str] = ...) -> _Path: ...
