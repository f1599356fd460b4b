"""A capture made of arrays: for recordings that another program has in memory, written as files or used as they are."""
import json
import pathlib

import numpy as np

from ._core import InputError, Recording, Trajectory, write_png


def write_capture(folder, *, cameras, images, masks, times, base, length, diameter, direction, bending_axis,
                  mass=None, gravity=(0.0, 0.0, -9.81), table=None, name=None):
    """Writes a capture (docs/formats.md 1), which train() and the program read.

    folder: that is made. cameras: Camera, as calibrated. images, masks, times: for each camera (T, H, W, 3) uint8, RGB as
    recorded; (T, H, W) uint8, 128 and more in the rope; (T,), s. base: Trajectory of the gripper. length, diameter: m, from
    the grasp. direction, bending_axis: (3,), unit, base frame: where the rope leaves the gripper, and an axis across it.
    mass: kg, or None. gravity: (3,), m/s^2, world. table: None, or (point, normal), world. Returns the folder.
    """
    folder = pathlib.Path(folder)
    frames = _frames(cameras, images, masks, times, base)
    if folder.exists() and any(folder.iterdir()):
        raise _input_error(str(folder), "is there already and not empty", "name another folder")
    document = _document(cameras, length, diameter, direction, bending_axis, mass, gravity, table, name or folder.name)
    document["base"] = "base.tum"
    for camera, described, (pictures, coverage, at) in zip(cameras, document["cameras"], frames):
        (folder / camera.name).mkdir(parents=True)
        (folder / "masks" / camera.name).mkdir(parents=True)
        for k, (picture, mask) in enumerate(zip(pictures, coverage)):
            write_png(folder / camera.name / f"{k:06d}.png", picture)
            write_png(folder / "masks" / camera.name / f"{k:06d}.png", mask)
        (folder / f"{camera.name}.txt").write_text("".join(f"{float(t)!r}\n" for t in at))
        described.update(images=f"{camera.name}/%06d.png", masks=f"masks/{camera.name}/%06d.png",
                         timestamps=f"{camera.name}.txt")
    base.write(folder / "base.tum")
    (folder / "capture.json").write_text(json.dumps(document, indent=1) + "\n")
    return folder


def recording(*, cameras, images, masks, times, base, length, diameter, direction, bending_axis, mass=None,
              gravity=(0.0, 0.0, -9.81), table=None, name="recording"):
    """Returns the same capture as a Recording, which train() takes; no file is written. Arguments: as of write_capture()."""
    frames = _frames(cameras, images, masks, times, base)
    document = _document(cameras, length, diameter, direction, bending_axis, mass, gravity, table, name)
    pictures, coverage, at = (list(part) for part in zip(*frames))
    return Recording(json.dumps(document), base, pictures, coverage, at)


def _document(cameras, length, diameter, direction, bending_axis, mass, gravity, table, name):
    """capture.json (docs/formats.md 1) without the names of files."""
    document = {
        "format": "chainsplat-capture/1",
        "name": name,
        "scenario": "tabletop" if table is not None else "free",
        "gravity": [float(x) for x in gravity],
        "object": {"length": float(length), "diameter": float(diameter)},
        "grasp": {"direction": [float(x) for x in direction], "bending_axis": [float(x) for x in bending_axis]},
        "cameras": [{
            "name": camera.name, "width": camera.width, "height": camera.height,
            "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "distortion": list(camera.distortion), "world_from_camera": camera.world_from_camera.ravel().tolist(),
        } for camera in cameras],
    }
    if mass is not None:
        document["object"]["mass"] = float(mass)
    if table is not None:
        point, normal = table
        document["table"] = {"point": [float(x) for x in point], "normal": [float(x) for x in normal]}
    return document


def _frames(cameras, images, masks, times, base):
    """Images, masks and times of each camera, checked."""
    if not cameras or not len(cameras) == len(images) == len(masks) == len(times):
        raise _input_error("`cameras`", "are not as many as images, masks and times", "give one of each for every camera")
    if not isinstance(base, Trajectory):
        raise _input_error("`base`", "is no Trajectory", "give Trajectory(times, poses)")
    frames = []
    for camera, pictures, coverage, at in zip(cameras, images, masks, times):
        pictures, coverage = np.asarray(pictures, np.uint8), np.asarray(coverage, np.uint8)
        shape = (len(at), camera.height, camera.width)
        if pictures.shape != shape + (3,) or coverage.shape != shape:
            raise _input_error(f"`images` of {camera.name}", f"have the shapes {pictures.shape} and {coverage.shape}",
                               f"give {shape + (3,)} and, of masks, {shape}")
        frames.append((pictures, coverage, np.asarray(at, float)))
    return frames


def _input_error(where, what, how):
    error = InputError(f"{where}: {what}; {how}")
    error.where, error.what, error.how = where, what, how
    return error
