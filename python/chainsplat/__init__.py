"""Digital twins of ropes from videos.

    import chainsplat as cs
    twin = cs.train("capture", "run")                    # or cs.Twin.load("run")
    states = twin.rollout()                              # under its own base's motion
    camera = cs.Capture.load("capture").cameras[0]
    images = twin.render(states, camera).rgb             # (T, H, W, 3) uint8

Lengths are in meters, angles in radians, time in seconds, mass in kilograms, forces in newtons. Poses are 4 x 4 matrices,
world frame unless said otherwise. What the library says goes to the logger "chainsplat". Long calls release the GIL;
Ctrl-C stops them, and a training then has a checkpoint. Errors are InputError (the request or its input is wrong) and
WorkError (the work failed, what exists is kept), with `where`, `what` and `how`. docs/api.md has all names.
"""
from ._core import (
    Camera,
    Capture,
    Error,
    Estimate,
    Excitation,
    Follower,
    Images,
    InputError,
    Parameters,
    Plan,
    Recording,
    States,
    Trajectory,
    Twin,
    WorkError,
    Workspace,
    __version__,
    evaluate,
    excite,
    identify,
    plan,
    set_threads,
    train,
    write_png,
)
from .captures import recording, write_capture

__all__ = [name for name in dir() if name[0] != "_" and name != "captures"] + ["__version__"]
