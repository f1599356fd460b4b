"""A first twin: first_twin.py CAPTURE RUN - trains, says what the rope is like, rolls it out and draws that."""
import sys

import numpy as np

import chainsplat as cs

capture, run = sys.argv[1:]
twin = cs.train(capture, run, progress=lambda stage, step, *_: step == 0 and print(stage))
for line in twin.verdict:
    print("!", line)
for name, (value, sigma, unit) in twin.properties().items():
    print(f"{name:24} {value:10.4g} +- {sigma:.2g} {unit}")

states = twin.rollout()
camera = twin.cameras(cs.Capture.load(capture).cameras)[0]
images = twin.render(states, camera, times=np.linspace(states.time[0], states.time[-1], 4))
cs.write_png(f"{run}/rollout.png", np.hstack(images.rgb))
print(f"{len(states)} states; four of them: {run}/rollout.png")
