"""The Python module against the program's own output and against finite differences."""
import csv
import json
import logging
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import unittest

import numpy as np

import chainsplat as cs

DEMO = pathlib.Path(os.environ["CHAINSPLAT_ASSETS"]) / "demo_free_30"
PROGRAM = os.environ["CHAINSPLAT_PROGRAM"]
logging.getLogger("chainsplat").setLevel(logging.ERROR)


def table(file):
    with open(file) as lines:
        rows = list(csv.reader(lines))
    return rows[0], np.array(rows[1:], float)


class Module(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)
        cls.run_folder = pathlib.Path(cls.folder.name) / "run"
        cls.stages = []
        cls.twin = cs.train(DEMO, cls.run_folder, joints=3, bending="spatial", frames="0:20",
                            progress=lambda stage, step, total, loss: cls.stages.append(stage))

    def camera(self):
        return self.twin.cameras(cs.Capture.load(DEMO).cameras)[0]

    def program(self, *arguments):
        subprocess.run([PROGRAM, *map(str, arguments)], check=True, capture_output=True)

    def test_train_reports_its_stages_and_saves_what_it_returns(self):
        self.assertEqual({"recognize", "identify", "evaluate"} - set(self.stages), set())
        document = json.loads((self.run_folder / "twin.json").read_text())
        estimates = self.twin.estimates
        self.assertEqual(document["identification"]["names"], estimates["names"])
        np.testing.assert_array_equal(document["identification"]["estimates"], estimates["values"])
        np.testing.assert_array_equal([j["stiffness"] for j in document["chain"]["joints"]], self.twin.parameters.stiffness)
        self.assertEqual((self.twin.angles, self.twin.links), (6, 4))
        np.testing.assert_array_equal(table(self.run_folder / "states.csv")[1][:, 1:7], self.twin.states.theta)

    def test_rollout_is_the_programs(self):
        out = pathlib.Path(self.folder.name) / "states.csv"
        self.program("rollout", self.run_folder, "-o", out)
        states = self.twin.rollout()
        numbers = table(out)[1]
        np.testing.assert_array_equal(numbers[:, 0], states.time)
        np.testing.assert_array_equal(numbers[:, 1:], np.hstack([states.theta, states.thetadot]))

    def test_rollout_under_another_base_and_from_a_state_is_the_programs(self):
        folder = pathlib.Path(self.folder.name)
        times = np.linspace(0.0, 1.0, 61)
        poses = np.stack([self.twin.base.pose(self.twin.base.start)] * 61)
        poses[:, 0, 3] += 0.05 * np.sin(2 * np.pi * times)
        base = cs.Trajectory(times, poses)
        base.write(folder / "base.tum")
        self.program("rollout", self.run_folder, "--base", folder / "base.tum", "-o", folder / "moved.csv")
        np.testing.assert_allclose(table(folder / "moved.csv")[1][:, 1:7], self.twin.rollout(base).theta, atol=1e-9)
        start = self.twin.rollout(base).theta[10]
        rates = np.full(6, 0.3)
        (folder / "start.csv").write_text(",".join(["time"] + [f"theta_{i}" for i in range(1, 7)] +
                                                   [f"thetadot_{i}" for i in range(1, 7)]) + "\n" +
                                          ",".join(repr(float(x)) for x in [0.0, *start, *rates]) + "\n")
        self.program("rollout", self.run_folder, "--base", folder / "base.tum", "--initial", folder / "start.csv",
                     "-o", folder / "from.csv")
        np.testing.assert_allclose(table(folder / "from.csv")[1][:, 1:7],
                                   self.twin.rollout(base, initial=(start, rates)).theta, atol=1e-9)

    def test_images_are_the_programs(self):
        out = pathlib.Path(self.folder.name) / "drawn"
        self.program("render", self.run_folder, "--camera", f"{DEMO}:cam0", "--mask", "-o", out)
        states = self.twin.states
        drawn = self.twin.render(states, self.camera())
        self.assertEqual(drawn.rgb.shape, (20, 240, 320, 3))
        self.assertFalse(drawn.rgb.flags.owndata)
        cs.write_png(pathlib.Path(self.folder.name) / "third.png", drawn.rgb[3])
        self.assertEqual((pathlib.Path(self.folder.name) / "third.png").read_bytes(),
                         (out / "cam0" / "000003.png").read_bytes())
        cs.write_png(pathlib.Path(self.folder.name) / "third.mask.png", drawn.mask[3])
        self.assertEqual((pathlib.Path(self.folder.name) / "third.mask.png").read_bytes(),
                         (out / "cam0" / "000003.mask.png").read_bytes())
        # and lie where the rope is: its centerline projects into them
        line = self.twin.centerline(states.theta[3], self.twin.base.pose(states.time[3]))
        columns, rows = np.floor(self.camera().project(line)).astype(int).T
        self.assertGreater(np.mean(drawn.mask[3][rows, columns] == 255), 0.9)
        images = drawn.rgb
        del drawn  # the arrays keep the memory
        self.assertGreater(images[3].max(), 50)

    def test_depth_is_that_of_the_rope(self):
        drawn = self.twin.render(self.twin.states, self.camera(), times=[self.twin.states.time[3]], depth=True)
        depth = drawn.depth[0]
        line = self.twin.centerline(self.twin.states.theta[3], self.twin.base.pose(self.twin.states.time[3]))
        camera_from_world = np.linalg.inv(self.camera().world_from_camera)
        z = (line @ camera_from_world[:3, :3].T + camera_from_world[:3, 3])[:, 2]
        self.assertTrue(np.all(np.abs(depth[depth > 0] - z.mean()) < self.twin.length))
        self.assertGreater(np.count_nonzero(depth), 100)

    def test_jacobian_is_the_difference_of_points(self):
        theta, base = self.twin.states.theta[5], self.twin.base.pose(0.1)
        count = 13
        for index in (3, 7, 12):
            s = self.twin.length * index / (count - 1)
            jacobian = self.twin.jacobian(theta, s, base)
            for k in range(self.twin.angles):
                step = np.zeros(self.twin.angles)
                step[k] = 1e-6
                there = [self.twin.centerline(theta + sign * step, base, count)[index] for sign in (1, -1)]
                np.testing.assert_allclose(jacobian[:, k], (there[0] - there[1]) / 2e-6, atol=1e-8)

    def test_link_poses_begin_at_the_joints(self):
        poses = self.twin.link_poses(np.zeros(6))
        starts = [0.0, 0.0, self.twin.length / 3, 2 * self.twin.length / 3]  # mathematics.md 2.1
        for pose, start in zip(poses, starts):
            np.testing.assert_allclose(np.linalg.norm(pose[:3, 3]), start, atol=1e-12)
        base = self.twin.base.pose(0.5)
        theta = self.twin.states.theta[7]
        np.testing.assert_allclose(self.twin.link_poses(theta, base), base @ self.twin.link_poses(theta), atol=1e-12)

    def test_rest_is_where_nothing_moves(self):
        base = self.twin.base.pose(0.0)
        theta = self.twin.rest(base)
        held = cs.Trajectory([0.0], base[None])
        states = self.twin.rollout(held, initial=(theta, np.zeros(6)), times=[0.0, 0.5, 1.0])
        np.testing.assert_allclose(states.theta, np.stack([theta] * 3), atol=1e-6)

    def test_a_batch_is_its_rollouts(self):
        samples = self.twin.sample(5, seed=3)
        batch = self.twin.rollout_batch(samples)
        self.assertEqual(batch["theta"].shape[0], 5)
        for sample, theta in zip(samples, batch["theta"]):
            np.testing.assert_array_equal(theta, self.twin.rollout(parameters=sample).theta)
        states = [(self.twin.states.theta[k], np.zeros(6)) for k in (0, 4)]
        bases = [self.twin.base, cs.Trajectory([0.0], self.twin.base.pose(0.0)[None])]
        batch = self.twin.rollout_batch(bases=bases, initials=states, times=np.linspace(0, 0.4, 9))
        for k in range(2):
            np.testing.assert_array_equal(
                batch["theta"][k], self.twin.rollout(bases[k], initial=states[k], times=np.linspace(0, 0.4, 9)).theta)
        with self.assertRaises(cs.InputError):
            self.twin.rollout_batch(samples, bases=bases)

    def test_samples_have_the_covariance(self):
        estimates = self.twin.estimates
        of = [estimates["names"].index(f"rest_angle_{k}") for k in (1, 4)]
        drawn = np.array([p.rest_angle[[0, 3]] for p in self.twin.sample(2000)])
        told = estimates["covariance"][np.ix_(of, of)]
        scale = np.sqrt(np.outer(np.diag(told), np.diag(told)))
        np.testing.assert_allclose(np.cov(drawn.T) / scale, told / scale, atol=0.12)
        np.testing.assert_allclose(drawn.mean(0), self.twin.parameters.rest_angle[[0, 3]], atol=4 * np.sqrt(scale.max() / 2000))

    def test_a_motion_beyond_the_identified_one_is_warned_of(self):
        poses = np.stack([np.eye(4)] * 61)
        poses[:, :3, 3] = self.twin.base.pose(0.0)[:3, 3]
        poses[:, 0, 3] += 0.05 * np.sin(np.linspace(0.0, 0.5, 61) * 4 * np.pi) ** 2  # 30 m/s^2
        with self.assertLogs("chainsplat", "WARNING") as log:
            self.twin.rollout(cs.Trajectory(np.linspace(0.0, 0.5, 61), poses))
        self.assertIn("what the twin was identified in", log.output[0])

    def test_derivatives_are_differences(self):
        times = np.linspace(0.0, 0.5, 16)
        initial = (self.twin.states.theta[0], np.zeros(6))
        name = "log_stiffness"
        sway = np.stack([np.eye(4)] * 31)
        sway[:, 0, 3] = np.sin(np.linspace(0, 6, 31)) ** 2
        direction = cs.Trajectory(np.linspace(0, 0.6, 31), sway)
        found = self.twin.rollout_derivatives([name, "theta_2", "thetadot_5"], initial=initial, times=times,
                                              directions=[direction])

        def rolled(stiffness=0.0, theta=0.0, rate=0.0):
            parameters = cs.Parameters(self.twin.parameters)
            parameters.stiffness = parameters.stiffness * np.exp(stiffness)
            parameters.torsional_stiffness = parameters.torsional_stiffness * np.exp(stiffness)  # goes along
            at = initial[0].copy(), initial[1].copy()
            at[0][1] += theta
            at[1][4] += rate
            return self.twin.rollout(initial=at, times=times, parameters=parameters).theta

        for column, change in enumerate(("stiffness", "theta", "rate")):
            step = 1e-4
            difference = (rolled(**{change: step}) - rolled(**{change: -step})) / (2 * step)
            scale = np.abs(difference).max()
            np.testing.assert_allclose(found["theta"][:, :, column], difference, atol=0.02 * scale)

        def displaced(amplitude):  # samples of the base and of the direction at the same times
            at = np.linspace(0, 0.6, 121)
            poses = np.stack([self.twin.base.pose(t) for t in at])
            poses[:, :3, 3] += amplitude * np.stack([direction.pose(t)[:3, 3] for t in at])
            return self.twin.rollout(cs.Trajectory(at, poses), initial=initial, times=times).theta

        difference = (displaced(1e-3) - displaced(-1e-3)) / 2e-3
        np.testing.assert_allclose(found["theta_by_base"][:, :, 0], difference, atol=0.03 * np.abs(difference).max())

    def test_follower_finds_what_training_recognized(self):
        capture = cs.Capture.load(DEMO, images=True, last=20)
        for solver, bound in (("newton", 0.004), ("silhouette", 0.01)):
            follower = cs.Follower(self.twin, capture.cameras, self.twin.base, solver=solver)
            errors = []
            for k in range(20):
                moment = capture.times[0][k]
                found = follower.update_all([capture.image(c, k) for c in range(3)], [capture.mask(c, k) for c in range(3)],
                                            moment)
                self.assertEqual(found.status, "following")
                self.assertEqual(found.grasp.shape, (4, 4))
                pose = self.twin.base.pose(moment)
                errors.append(self.twin.centerline(found.theta, pose) -
                              self.twin.centerline(self.twin.states.theta[k], pose))
            self.assertLess(np.sqrt(np.mean(np.sum(np.square(errors), -1))), bound)  # m
            with self.assertRaises(cs.InputError):
                follower.update(capture.image(0, 0), capture.mask(0, 0), 0.0)  # time goes back

    def test_follower_takes_poses_as_they_come_and_makes_masks(self):
        capture = cs.Capture.load(DEMO, images=True, camera="cam0", last=20)
        times = capture.times[0]
        follower = cs.Follower(self.twin, capture.cameras, self.twin.base.pose(times[0]), start=times[0] - 1 / 30)
        for k in range(20):
            found = follower.update(capture.image(0, k), None, times[k], base=self.twin.base.pose(times[k]))
            self.assertTrue(found.seen)
        self.assertGreater(found.iou, 0.8)
        self.assertEqual(found.covariance.shape, (12, 12))

    def test_plan_hits_its_target(self):
        base = self.twin.base.pose(self.twin.base.start)
        tip = self.twin.centerline(self.twin.rest(base), base)[-1]
        plan = cs.plan(self.twin, tip + [0.08, 0.0, 0.02], horizon=1.5)
        self.assertTrue(plan.reached)
        motion = plan.base(200)
        states = self.twin.rollout(motion, times=np.linspace(0.0, plan.duration, 301))
        reached = [self.twin.centerline(theta, motion.pose(t))[-1] for t, theta in zip(states.time, states.theta)]
        self.assertLess(np.min(np.linalg.norm(np.array(reached) - tip - [0.08, 0.0, 0.02], axis=1)), 0.004)

    def test_a_proposed_motion_tells_more_and_keeps_its_limits(self):
        motion = cs.excite(self.twin, duration=2.0, stroke=0.1, velocity=1.0)
        base = motion.base(200)
        places = np.array([base.pose(t)[:3, 3] for t in np.linspace(0.0, motion.duration, 401)])
        self.assertLess(np.max(np.abs(places - places[0])), 0.1001)  # m, along each axis
        speed = np.linalg.norm(np.diff(places, axis=0), axis=1) / (motion.duration / 400)
        self.assertLess(np.max(speed), 1.01)
        for errors in motion.parameters.values():
            self.assertLessEqual(errors["excited"], errors["now"] * (1.0 + 1e-9))
        self.assertGreater(motion.gain, 0.0)
        np.testing.assert_array_equal(base.pose(0.7), cs.excite(self.twin, duration=2.0, stroke=0.1, velocity=1.0)
                                      .base(200).pose(0.7))  # the same request, the same motion
        with self.assertRaises(cs.InputError) as refused:
            cs.excite(self.twin, duration=-1.0)
        self.assertIn("duration", refused.exception.where)

    def test_forces_of_a_free_rope_are_small(self):
        found = self.twin.forces(self.twin.rollout())
        self.assertEqual(found["force"].shape, (len(found["time"]), 3))
        self.assertLess(np.median(np.linalg.norm(found["force"], axis=1)), 0.05)  # N, of a rope of 60 g

    def test_export_and_evaluate(self):
        file = pathlib.Path(self.folder.name) / "twin.npz"
        self.twin.export(file)
        with np.load(file) as arrays:
            self.assertTrue(any(array.shape[-2:] == (4, 4) for array in arrays.values()))
        metrics = cs.evaluate(self.run_folder, DEMO)
        document = json.loads((self.run_folder / "metrics.json").read_text())
        self.assertGreater(metrics["rollout"]["iou"], 0.5)
        self.assertIn("recognized", document)
        self.assertNotIn("lpips", metrics["rollout"])
        trunks = DEMO.parent.parent / "tests" / "data" / "lpips"
        with self.assertRaises(cs.InputError):
            cs.evaluate(self.run_folder, DEMO, lpips=trunks / "one_output.onnx")
        metrics = cs.evaluate(self.run_folder, DEMO, lpips=trunks / "trunk.onnx")
        for part in ("recognized", "rollout"):
            self.assertGreater(metrics[part]["lpips"], 0)
            self.assertLess(metrics[part]["lpips"], 0.05)
            self.assertEqual(metrics[part]["psnr"], document[part]["mean"]["psnr"])

    def test_a_capture_from_arrays_is_read_and_trained(self):
        capture = cs.Capture.load(DEMO, images=True, last=8)
        folder = pathlib.Path(self.folder.name) / "arrays"
        cameras = capture.cameras
        arrays = dict(cameras=cameras, base=capture.base, length=capture.length, diameter=capture.diameter,
                      images=[[capture.image(c, k) for k in range(8)] for c in range(3)],
                      masks=[[capture.mask(c, k) for k in range(8)] for c in range(3)],
                      times=[capture.times[c][:8] for c in range(3)], direction=(0, 0, -1), bending_axis=(0, 1, 0))
        cs.write_capture(folder, **arrays)
        again = cs.Capture.load(folder, images=True)
        np.testing.assert_array_equal(again.image(1, 5), capture.image(1, 5))
        np.testing.assert_allclose(again.cameras[2].world_from_camera, cameras[2].world_from_camera, atol=1e-12)
        options = dict(joints=3, stages=["recognize", "evaluate"])
        run = pathlib.Path(self.folder.name) / "arrays_run"
        twin = cs.train(folder, run, **options)
        self.assertEqual(len(twin.states), 8)
        # the same bits without files
        recording = cs.recording(**arrays)
        run_in_memory = pathlib.Path(self.folder.name) / "memory_run"
        in_memory = cs.train(recording, run_in_memory, **options)
        np.testing.assert_array_equal(in_memory.states.theta, twin.states.theta)
        for name in ("gaussians.ply", "metrics.json"):
            self.assertEqual((run_in_memory / name).read_bytes(), (run / name).read_bytes())
        self.assertEqual(len(cs.train(recording, run_in_memory, resume=True, **options).states), 8)
        workspace = cs.Workspace()
        for _ in range(2):
            shared = cs.train(recording, run_in_memory, force=True, workspace=workspace, **options)
            np.testing.assert_array_equal(shared.states.theta, twin.states.theta)
            self.assertEqual((run_in_memory / "gaussians.ply").read_bytes(), (run / "gaussians.ply").read_bytes())
        arrays["times"][1] = arrays["times"][1][::-1]
        with self.assertRaises(cs.InputError) as caught:
            cs.train(cs.recording(**arrays), pathlib.Path(self.folder.name) / "no_run")
        self.assertIn("`times` of frame 1", caught.exception.what)
        with self.assertRaises(cs.InputError):
            cs.train(None, run)

    def test_errors_say_where_what_and_how(self):
        with self.assertRaises(cs.InputError) as caught:
            cs.Twin.load("/nowhere")
        self.assertIn("/nowhere", caught.exception.where)
        self.assertTrue(caught.exception.what and caught.exception.how)
        self.assertIsInstance(caught.exception, ValueError)
        with self.assertRaises(cs.InputError) as caught:
            self.twin.link_poses(np.zeros(5))
        self.assertEqual(caught.exception.where, "`theta`")
        with self.assertRaises(cs.InputError) as caught:
            cs.train(DEMO, self.run_folder / "other", joints=0)
        self.assertEqual(caught.exception.where, "`joints`")
        with self.assertRaises(cs.InputError):
            cs.train(DEMO, self.run_folder / "other", colour="red")
        with self.assertRaises(cs.WorkError):
            self.twin.export("/proc/nothing.glb")

    def test_interrupt_leaves_a_checkpoint(self):
        run = pathlib.Path(self.folder.name) / "stopped"
        options = dict(joints=3, bending="spatial", frames="0:20")

        def interrupt(stage, step, total, loss):
            if stage == "recognize" and step > 0:
                signal.raise_signal(signal.SIGINT)

        with self.assertRaises(KeyboardInterrupt):
            cs.train(DEMO, run, progress=interrupt, **options)
        self.assertTrue((run / "checkpoint").is_dir())
        twin = cs.train(DEMO, run, resume=True, **options)
        np.testing.assert_array_equal(twin.states.theta, self.twin.states.theta)

    def test_what_progress_raises_comes_through(self):
        def broken(*_):
            raise RuntimeError("enough")

        with self.assertRaisesRegex(RuntimeError, "enough"):
            cs.train(DEMO, pathlib.Path(self.folder.name) / "broken", joints=3, progress=broken)

    def test_long_calls_let_other_threads_run(self):
        turns = 0
        done = threading.Event()

        def count():
            nonlocal turns
            while not done.is_set():
                turns += 1
                time.sleep(1e-3)

        thread = threading.Thread(target=count)
        thread.start()
        before = turns
        self.twin.rollout_batch(self.twin.sample(60), rate=200)
        after = turns
        done.set()
        thread.join()
        self.assertGreater(after, before)


    def test_examples_run(self):
        examples = pathlib.Path(__file__).parent.parent.parent / "examples/python"

        self.first = pathlib.Path(self.folder.name) / "first"

        def example(name, *arguments):
            done = subprocess.run([sys.executable, examples / f"{name}.py", *map(str, arguments)], capture_output=True,
                                  text=True)
            self.assertEqual(done.returncode, 0, done.stderr)
            return done.stdout

        self.assertIn("bending_stiffness", example("first_twin", DEMO, self.first))
        self.assertGreater((self.first / "rollout.png").stat().st_size, 1000)
        rows = [line.split() for line in example("prediction_band", self.run_folder).splitlines()[1:]]
        self.assertEqual(len(rows[0]), 5)
        self.assertGreater(float(rows[-1][4]), 0.0)
        self.assertEqual({line.split()[1] for line in example("following", self.run_folder, DEMO).splitlines()}, {"following"})
        base = self.twin.base.pose(self.twin.base.start)
        target = self.twin.centerline(self.twin.rest(base), base)[-1] + [0.06, 0.0, 0.02]
        out = pathlib.Path(self.folder.name) / "hit.tum"
        self.assertIn("hits at", example("planned_hit", self.run_folder, ",".join(map(str, target)), out))
        self.assertTrue(cs.Trajectory.read(out).end > 1.0)

    def test_example_of_mujoco_runs(self):
        script = pathlib.Path(__file__).parent.parent.parent / "examples/python/mujoco_comparison.py"
        picture = pathlib.Path(self.folder.name) / "mujoco.png"
        motion = pathlib.Path(self.folder.name) / "aside.tum"  # a base motion that is not the twin's own
        time = np.linspace(0.0, 1.0, 121)
        poses = np.repeat(self.twin.base.pose(0.0)[None], len(time), 0)
        poses[:, 1, 3] += 0.05 * np.sin(np.pi * time) ** 2
        cs.Trajectory(time, poses).write(motion)
        arguments = [str(self.run_folder), str(motion), str(picture)]
        without = "import runpy, sys; sys.modules['mujoco'] = None; runpy.run_path(sys.argv[1], run_name='__main__')"
        done = subprocess.run([sys.executable, "-c", without, script, *arguments], capture_output=True, text=True)
        self.assertEqual((done.returncode, done.stderr.count("\n")), (1, 1), done.stderr)
        self.assertIn("pip install mujoco", done.stderr)
        self.assertFalse(picture.exists())

        python = os.environ.get("CHAINSPLAT_PYTHON", sys.executable)
        if subprocess.run([python, "-c", "import mujoco, chainsplat"], capture_output=True).returncode != 0:
            self.skipTest(f"{python} has no mujoco that goes with the module (CHAINSPLAT_PYTHON names another one)")
        done = subprocess.run([python, script, *arguments], capture_output=True, text=True)
        self.assertEqual(done.returncode, 0, done.stderr)
        said = re.match(r"\d+ states: angles ([\d.]+) degrees RMS apart, centerline ([\d.]+) mm RMS, ", done.stdout)
        self.assertLess(float(said[1]), 0.01)
        self.assertLess(float(said[2]), 0.1)
        self.assertGreater(picture.stat().st_size, 1000)

    def test_numpy_of_another_layout_is_refused(self):
        pretend = "import numpy; numpy.__version__ = '2.0.0'; import chainsplat"
        done = subprocess.run([sys.executable, "-c", pretend], capture_output=True, text=True)
        if tuple(map(int, os.environ["CHAINSPLAT_PYBIND11"].split(".")[:2])) < (2, 12):
            self.assertIn("ImportError: chainsplat: it was built with pybind11", done.stderr)
        else:
            self.assertEqual(done.returncode, 0, done.stderr)


class Stubs(unittest.TestCase):
    def test_stubs_have_the_names_of_the_module(self):
        import ast
        stub = pathlib.Path(cs.__file__).with_name("__init__.pyi")
        tree = ast.parse(stub.read_text())
        names = {node.name: node for node in tree.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))}
        public = {name for name in cs.__all__ if not name.startswith("_")}
        self.assertEqual(set(names), public)
        for name, node in names.items():
            if not isinstance(node, ast.ClassDef) or issubclass(getattr(cs, name), Exception):
                continue
            told = {m.name for m in node.body if isinstance(m, ast.FunctionDef)} | {
                m.target.id for m in node.body if isinstance(m, ast.AnnAssign)}
            real = {m for m in vars(getattr(cs, name)) if not m.startswith("_") or m in ("__init__", "__len__")}
            self.assertEqual(told - {"__init__"}, real - {"__init__"}, name)


if __name__ == "__main__":
    unittest.main()
