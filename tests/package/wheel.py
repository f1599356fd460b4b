"""A script of one's own with an installed wheel: wheel.py RUN CAPTURE.

Loads a twin, rolls it out, draws it, follows it from its own pictures; files of images and LPIPS are refused with a reason.
"""
import pathlib
import sys

import numpy as np

import chainsplat as cs

run, capture = sys.argv[1:]
twin = cs.Twin.load(run)
states = twin.rollout()
along_y = np.array([[1, 0, 0, 0], [0, 0, 1, -1], [0, -1, 0, 0.4], [0, 0, 0, 1]], float)
camera = cs.Camera("own", 320, 240, fx=300, fy=300, cx=160, cy=120, world_from_camera=along_y)
drawn = twin.render(states, camera)
images, masks = drawn.rgb, drawn.mask
assert masks[5].any(), "nothing is drawn"

follower = cs.Follower(twin, [camera], twin.base)
for image, mask, time in zip(images[:10], masks[:10], states.time):
    estimate = follower.update(image, mask, time)
ends = [twin.centerline(theta)[-1] for theta in (estimate.theta, states.at(estimate.time))]
print("%s, the free end is followed to %.1f mm" % (images.shape, 1e3 * np.linalg.norm(ends[0] - ends[1])))
assert np.linalg.norm(ends[0] - ends[1]) < 0.01
try:
    cs.Capture.load(capture)
    sys.exit("files of images are read, of which this wheel has no reader")
except cs.WorkError as error:
    print(error)
trunk = pathlib.Path(__file__).parent.parent / "data" / "lpips" / "trunk.onnx"
try:
    cs.evaluate(run, capture, lpips=trunk)
    sys.exit("LPIPS is computed, for which this wheel has no networks")
except cs.WorkError as error:
    print(error)
