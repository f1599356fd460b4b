"""A script of one's own: own.py CAPTURE RUN - trains, rolls out, draws."""
import sys

import chainsplat as cs

capture, run = sys.argv[1:]
twin = cs.train(capture, run, joints=3, frames="0:8")
states = twin.rollout()
camera = cs.Capture.load(capture).cameras[0]
images = twin.render(states, camera).rgb
print(images.shape, "rope" if images[5].any() else "nothing")
