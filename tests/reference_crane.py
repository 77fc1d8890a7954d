"""One slow crane, written a second time: the reference that crane_env.py is held against.

It follows docs/environment.md and assets/README.md, in plain MuJoCo calls and Python's own numbers.
All constants are written again. Each episode begins with a new model and new data, so nothing can
be left over from the one before.
"""

from collections import deque
from copy import copy
from functools import cache
from math import acos, atan2, copysign, cos, dist, exp, floor, hypot, inf, log, pi, sin, sqrt, tanh
from pathlib import Path

import mujoco
import numpy as np
from numpy.random import default_rng

from crane_env import sample_start

CRANE_XML = Path(__file__).parents[1] / "assets" / "crane.xml"
G, TIMESTEP = 9.81, 0.005
JOINTS = ["q1", "q2", "q3", "q4", "q5", "q6", "q7", "q8"]
DRIVEN = ["q1", "q2", "q3", "q4", "q7", "q8"]
SERVOS = ["q1", "q2", "q3", "q4", "q4_stage2", "q7", "q8", "q8_inner"]
OF_SERVO = [DRIVEN.index(name.split("_")[0]) for name in SERVOS]
RANGES = [(-3.71, 3.71), (-1.2, 1.563), (-0.91, 1.5), (0, 2.236), (-pi / 2, pi / 2)]
RANGES += [(pi / 4, 3 * pi / 4), (-pi, pi), (0, 3)]
SLOWEST = [-0.764, -0.326, -0.344, -0.630, -2.12, -1.8]
FASTEST = [0.802, 0.239, 0.326, 0.400, 2.12, 1.8]
FORCE_LIMIT = [3.181e4, 2e5, 1e5, 5e4, 2.2e3, 1.2e4]
SERVO_KP = [2e7, 4e7, 2e7, 4e6, 1e5, 5e4]

# hydraulic drives
DEAD_TIME = [0.117, 0.080, 0.044, 0.060, 0.058, 0.058]
LAG = [0.007, 0.026, 0.069, 0.008, 0.130, 0.130]
OIL_IN = [12.724e-4, 9.032e-3, 5.026e-3, 2.592e-3, 1.4324e-4, 4.61e-4]  # 4.737e-3 * 0.292 / 3
OIL_OUT = [12.724e-4, 15.394e-3, 12.724e-3, 1.257e-3, 1.4324e-4, 7.64e-4]
FULL_TELESCOPE = 3.849e-3  # out, without the help of the rod side
PUMP, PRESSURE = 0.95 * 1.4e-3, 25e6
DRAWN = {  # in this order: nominal, lowest, highest
    "stiffness": ([2.19e5, 1.50e6, 1.73e6, 1.40e5, 1.23e4, 2.5e4],
                  [2.01e5, 1.28e6, 2.89e5, 1.05e5, 2.55e3, 1.25e4],
                  [3.99e5, 2.75e6, 1.73e6, 2.63e6, 1.24e4, 5.0e4]),
    "damping": ([1.12e4, 6.63e4, 3.88e4, 9.4e3, 757.0, 3.4e3],
                [6.32e3, 6.62e4, 3.29e4, 8.03e3, 62.9, 2.7e3],
                [1.65e4, 3.81e5, 7.05e4, 1.61e5, 1596.0, 4.3e3]),
    "extra_delay": ([0], [-0.02], [0.02]),
    "gain": ([1] * 12, [0.98, 0.93, 0.95, 0.9, 1.05, 0.9] * 2,
             [1.02, 1.15, 1.2, 1.25, 1.2, 1.1] * 2),
    "density": ([650], [450], [950]), "friction": ([1], [0.5], [1.5]),
    "pose_error": ([0] * 3, [-0.057] * 3, [0.057] * 3), "yaw_error": ([0], [-0.1745], [0.1745]),
    "joint_error": ([0] * 8, *[[e, e, e, 0, e, e, e, e] for e in (-0.0087, 0.0087)]),
    "swing": ([0, 0], [-0.1745] * 2, [0.1745] * 2),
}  # fmt: skip


def clip(x, low, high):
    return min(max(x, low), high)


def half_turn(angle):
    """The same line, in [-pi/2, pi/2)."""
    return angle - pi * floor(angle / pi + 0.5)


def boom_cylinder(q2):
    """Length (m): it pushes the knee of two bars, 0.57 m from the column, 0.124 m from the boom."""
    q2 = max(q2, -1.18)
    column, foot = (-0.12, -0.07), (0.433, -1.7682)
    boom = (0.4539 * cos(q2) + 0.036 * sin(q2), 0.4539 * sin(q2) - 0.036 * cos(q2))
    apart = dist(column, boom)
    at_column = acos(clip((0.57**2 + apart**2 - 0.124**2) / (2 * 0.57 * apart), -1, 1))
    way = atan2(boom[1] - column[1], boom[0] - column[0]) - at_column
    return dist(foot, (column[0] + 0.57 * cos(way), column[1] + 0.57 * sin(way)))


def arm_lever(q3):
    foot = (-1.6802, -0.0485)
    rod = (0.468 * sin(q3) - 0.118 * cos(q3), -0.118 * sin(q3) - 0.468 * cos(q3))
    return (foot[0] * rod[1] - foot[1] * rod[0]) / dist(foot, rod)


def oil_of(q2, q3, speeds, telescope_force):
    """Oil per movement of each driven joint, m^3/rad and m^3/m."""
    step, oil = 1e-4, [out if v >= 0 else back for v, out, back in zip(speeds, OIL_OUT, OIL_IN)]
    oil[1] *= max((boom_cylinder(q2 + step) - boom_cylinder(q2 - step)) / (2 * step), 0.05)
    oil[2] *= max(arm_lever(q3), 0.05)
    if speeds[3] >= 0 and telescope_force > PRESSURE * OIL_OUT[3]:
        oil[3] = FULL_TELESCOPE
    return oil


@cache
def compiled(contact, hydraulic):
    """assets/crane.xml with the paper's contacts, and with a memory of commands for dead times."""
    spec = mujoco.MjSpec.from_file(str(CRANE_XML))
    if contact == "sdf":
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
        spec.option.solver = mujoco.mjtSolver.mjSOL_CG
        spec.option.sdf_initpoints, spec.option.sdf_iterations = 8, 5
        for geom in spec.geoms:
            if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
                geom.type, geom.conaffinity = mujoco.mjtGeom.mjGEOM_SDF, 4
            elif geom.parent.name.startswith("jaw") and geom.conaffinity:
                geom.conaffinity = 3  # capsules still meet ground and truck
        spec.geom("log").contype, spec.geom("log_capsule").contype = 4, 8
    for name in SERVOS if hydraulic else ():
        spring = spec.actuator(f"{name}_integral")
        spring.delay, spring.nsample, spring.forcelimited = DEAD_TIME[0], 32, 1
        spring.forcerange = -1, 1
    return spec.compile()


class ReferenceCrane:
    """seeds: the crane's own SeedSequence. met: conditions of a task's own, by their failure."""

    def __init__(self, seeds, options, hydraulic, diameter=None, difficulty=1.0, retry=0.0,
                 time_limit=9.0, reach_time=6.0, hold_time=0.5, met=None):  # fmt: skip
        self.options, self.hydraulic = options, hydraulic
        self.difficulty, self.retry, self.fixed_diameter = difficulty, retry, diameter
        self.time_limit, self.reach_time, self.hold_time = time_limit, reach_time, hold_time
        self.met, self.start_rng = met, default_rng(seeds)
        self.noise_rng = default_rng(seeds.generate_state(4))
        self.machine_rng = default_rng(seeds.generate_state(8)[4:])
        self.dt, self.piece = options["frame_skip"] * TIMESTEP, 4 if hydraulic else 5
        self.failed_starts, self.successes = deque(maxlen=4), deque(maxlen=10)

    # ---- the start of an episode

    def start(self):
        """Draw and place; the observation."""
        share = self.retry * (sum(self.successes) / len(self.successes) if self.successes else 0)
        self.repeated = bool(share and self.failed_starts and self.start_rng.random() < share)
        if self.repeated:
            chosen = self.start_rng.integers(len(self.failed_starts))
            self.drawn_start, machine = self.failed_starts[chosen]
        else:
            self.drawn_start = sample_start(self.start_rng)
        steps = -int(-(self.time_limit / self.dt - 1e-9) // 1)
        rows = steps + 1 if self.options["pose_noise"] == "step" else 1
        self.noise = self.noise_rng.uniform(-0.1, 0.1, (rows, 2)).tolist()
        self.drawn = {name: nominal for name, (nominal, _, _) in DRAWN.items()}
        share, uniform = self.options.get("randomize", 0.0), self.machine_rng.uniform
        for name, (nominal, low, high) in DRAWN.items() if share else ():
            if name in ("stiffness", "damping"):
                drawn = [exp(uniform(log(a), log(b))) for a, b in zip(low, high)]
            else:
                drawn = [uniform(a, b) for a, b in zip(low, high)]
            self.drawn[name] = [n + share * (x - n) for n, x in zip(nominal, drawn)]
        self.drawn = machine if self.repeated else self.drawn
        self.steps, self.reached_at, self.command = 0, inf, [0.0] * 6
        self.peak, self.valve_speed, self.telescope_wait = 0.0, [0.0] * 6, 0.0
        self.kept, self.limits = {}, [[f, f] for f in FORCE_LIMIT]
        self.costs = {"litres": 0.0, "energy": 0.0, "swing_peak": 0.0, "time_up": inf}
        q, log_pose, diameter = self.eased(*self.drawn_start)
        self.place(q, log_pose, self.fixed_diameter or diameter)
        return self.observe()

    def eased(self, q, log_pose, diameter):
        """Towards a log under the tip, along the grapple, of mean diameter."""
        q1, q2, q3, q4, _, _, q7, _ = q
        (x, y, yaw), d = log_pose, self.difficulty
        tip = -0.18 + 3.49288 * cos(q2) - 0.3925 * cos(q2 + q3) + (3.157 + 2 * q4) * sin(q2 + q3)
        easy_radius = clip(tip, 5.5, 7.5)
        radius = easy_radius + d * (hypot(x, y) - easy_radius)
        azimuth = q1 + d * (atan2(y, x) - q1)
        yaw = half_turn(q1 - q7 + d * half_turn(yaw - (q1 - q7)))
        return q, (radius * cos(azimuth), radius * sin(azimuth), yaw), 0.55 + d * (diameter - 0.55)

    def place(self, q, log_pose, diameter):
        self.model = model = self.make_model(diameter)
        self.data = data = mujoco.MjData(model)
        self.address = {name: model.joint(name).qposadr[0] for name in [*JOINTS, *SERVOS]}
        self.servos = [self.address[name] for name in SERVOS]  # qpos and qvel have one order here
        swing5, swing6 = self.drawn["swing"]
        for name, value in zip(JOINTS, q + [0, 0, 0, 0, swing5, swing6, 0, 0]):
            for servo in {"q4": ["q4", "q4_stage2"], "q8": ["q8", "q8_inner"]}.get(name, [name]):
                data.joint(servo).qpos[0] = value
        x, y, yaw = log_pose
        log, turned = data.joint("log").qpos, [cos(yaw / 2), 0, 0, sin(yaw / 2)]
        mujoco.mju_mulQuat(log[3:], turned, [sqrt(0.5), -sqrt(0.5), 0, 0])  # lying along y, turned
        log[:3] = x, y, diameter / 2
        mujoco.mj_step1(model, data)
        for k, servo in enumerate(self.servos):  # each servo's integrator bears the static load
            data.act[k] = data.qpos[servo] + data.qfrc_bias[servo] / self.kp(k)

        crane = {model.body("K1").id}
        for body, parent in enumerate(model.body_parentid.tolist()):  # parents come first
            crane |= {body} if parent in crane else set()
        self.log, self.site = model.body("log").id, model.site("grapple_centre").id
        self.ground_geom, body_of = model.geom("ground").id, model.geom_bodyid.tolist()
        self.presses = [0 if b in crane else 1 if b == self.log else None for b in body_of]
        self.jaws = [model.body(name).id for name in ("jaw_outer", "jaw_inner")]

    def make_model(self, diameter):
        model = copy(compiled(self.options["contact"], self.hydraulic))
        radius, length = diameter / 2, 2.75
        self.diameter, self.mass = diameter, self.drawn["density"][0] * pi * radius**2 * length
        across = self.mass * (3 * radius**2 + length**2) / 12
        model.geom("log").size[:2] = radius, length / 2
        model.geom("log_capsule").size[:2] = radius, length / 2 - radius
        model.body("log").mass = self.mass
        model.body("log").inertia = across, across, self.mass * radius**2 / 2
        if self.hydraulic:
            for i, name in zip(OF_SERVO, SERVOS):
                spring, stiffness = model.actuator(f"{name}_integral"), self.drawn["stiffness"][i]
                spring.gainprm[0], spring.biasprm[1] = stiffness, -stiffness
                model.actuator_delay[spring.id] = DEAD_TIME[i] + self.drawn["extra_delay"][0]
                model.joint(name).damping = self.drawn["damping"][i]
                model.actuator(name).gainprm[0] = model.actuator(name).biasprm[2] = 0
            model.geom_friction[:] *= self.drawn["friction"][0]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    # ---- one step

    def step(self, action):
        """(observation, reward, info)."""
        action = [clip(float(a), -1, 1) for a in action]
        self.command = [a * (FASTEST[i] if a >= 0 else -SLOWEST[i]) for i, a in enumerate(action)]
        skip = self.options["frame_skip"]
        every = max(1, self.piece // skip)  # steps of the crane in one piece
        self.impact, done = 0.0, 0
        while done < skip:
            physics_steps = min(self.piece, skip - done)
            if self.steps % every == 0:
                self.begin_piece(physics_steps * every * TIMESTEP)
            for _ in range(physics_steps):
                mujoco.mj_step2(self.model, self.data)
                self.read_ground()
                mujoco.mj_step1(self.model, self.data)
                self.count_costs()
            done += physics_steps
        self.peak = max(self.peak, self.impact)
        self.steps += 1
        return self.observe(), *self.outcome()

    def follow(self, **state):
        """Take over a state that was found equal, so that rounding does not grow in contacts."""
        for name, value in state.items():
            getattr(self.data, name)[:] = value
        mujoco.mj_step1(self.model, self.data)

    def begin_piece(self, seconds):
        """Command, and what the oil may push with at most; the integrators lead by no more."""
        data = self.data
        self.limits = limits = [[f, f] for f in FORCE_LIMIT]
        if self.hydraulic:
            for way, direction in ((0, -1), (1, 1)):
                oil = oil_of(self.joint("q2"), self.joint("q3"), [direction] * 6, inf)
                for i, together in enumerate((1, 1, 1, 2, 1, 2)):
                    limits[i][way] = min(limits[i][way], PRESSURE * oil[i] / together)
            for k, i in enumerate(OF_SERVO):
                self.model.actuator_forcerange[8 + k] = -limits[i][0], limits[i][1]
        for k, (servo, i) in enumerate(zip(self.servos, OF_SERVO)):
            low, high = (force / self.kp(k) for force in limits[i])
            data.act[k] = clip(data.act[k], data.qpos[servo] - low, data.qpos[servo] + high)
        if self.hydraulic:
            speeds = self.oil_speeds(seconds)
            data.ctrl[8:] = [speeds[i] for i in OF_SERVO]
        else:
            data.ctrl[:] = [self.command[i] for i in OF_SERVO] * 2

    def oil_speeds(self, seconds):
        """What valves and pump let through in the mean over the next seconds."""
        gain, means = self.drawn["gain"], []
        wanted = [c * gain[i if c < 0 else 6 + i] for i, c in enumerate(self.command)]
        if abs(self.valve_speed[3]) < 1e-3 and abs(wanted[3]) >= 1e-3:
            self.telescope_wait += seconds
            wanted[3] = 0.0 if self.telescope_wait <= 0.10 else wanted[3]
        else:
            self.telescope_wait = 0.0
        for i, target in enumerate(wanted):
            away, decay = self.valve_speed[i] - target, exp(-seconds / LAG[i])
            means.append(target + away * LAG[i] / seconds * (1 - decay))
            self.valve_speed[i] = target + away * decay
        telescope = sum(self.spring(k) for k, name in enumerate(SERVOS) if name.startswith("q4"))
        oil = oil_of(self.joint("q2"), self.joint("q3"), means, telescope)
        demand = sum(o * abs(v) for o, v in zip(oil, means))
        return [v * min(1, PUMP / max(demand, 1e-9)) for v in means]

    def read_ground(self):
        """Forces of crane and log on the ground, at the beginning of this physics step."""
        data, wrench, force = self.data, np.zeros(6), [[0.0] * 3, [0.0] * 3]
        for k, (ground, other) in enumerate(data.contact.geom.tolist()):
            if ground == self.ground_geom and self.presses[other] is not None:
                mujoco.mj_contactForce(self.model, data, k, wrench)
                total, frame = force[self.presses[other]], data.contact.frame[k]
                for axis in range(3):
                    total[axis] += sum(frame[3 * row + axis] * wrench[row] for row in range(3))
        self.impact = max(self.impact, hypot(*force[0]))
        self.support = hypot(*force[0]) + hypot(*force[1])

    # ---- what is known of the state

    def kp(self, k):
        return (self.drawn["stiffness"] if self.hydraulic else SERVO_KP)[OF_SERVO[k]]

    def spring(self, k):
        """Force of the oil on a servo's joint."""
        low, high = self.limits[OF_SERVO[k]]
        return clip(self.kp(k) * (self.data.act[k] - self.data.qpos[self.servos[k]]), -low, high)

    def joint(self, name):
        return float(self.data.qpos[self.address[name]])

    def speed(self, name):
        return float(self.data.qvel[self.address[name]])

    def log_pose(self):
        return self.data.xpos[self.log].tolist(), self.data.xmat[self.log][[2, 5, 8]].tolist()

    def pose(self, log_centre, log_axis, slew, rotator, offset):
        """Delta_p, Delta_psi and the signed angle from the grapple to the log."""
        centre = self.data.site_xpos[self.site].tolist()
        grapple_x, grapple_y = self.data.site_xmat[self.site][[0, 3]].tolist()
        delta = [there - here for there, here in zip(log_centre, centre)]
        delta[2] += (0.8 - self.diameter) / 2 * (1 if offset == "plus" else -1)
        dot = (grapple_x * log_axis[0] + grapple_y * log_axis[1]) / hypot(*log_axis[:2])
        angle = half_turn(atan2(log_axis[1], log_axis[0]) - atan2(grapple_y, grapple_x))
        to_log = atan2(log_centre[1], log_centre[0]) - slew
        at_log = rotator + atan2(sin(to_log), cos(to_log)) - angle  # of q7, after the turn
        if abs(at_log) > 2.8:
            angle += copysign(pi, at_log)
        return delta, 1 - min(abs(dot), 1), angle

    def observe(self, **other_options):
        options, drawn = self.options | other_options, self.drawn
        centre, (x, y, z) = self.log_pose()
        yaw = drawn["yaw_error"][0]
        axis = (cos(yaw) * x - sin(yaw) * y, sin(yaw) * x + cos(yaw) * y, z)
        centre = [c + e for c, e in zip(centre, drawn["pose_error"])]
        q = [self.joint(name) + e for name, e in zip(JOINTS, drawn["joint_error"])]
        delta, psi, angle = self.pose(centre, axis, q[0], q[6], options["offset"])
        angle = angle if options["signed_yaw"] else psi
        if options["pose_noise"] != "none":
            of_p, of_o = self.noise[min(self.steps, len(self.noise) - 1)]
            far = sum(x * x for x in delta) / 8.0**2
            delta, angle = [x * (1 + of_p * far) for x in delta], angle * (1 + of_o * far)
        if options["axes"] == "crane":
            x, y, z = delta
            delta = [cos(q[0]) * x + sin(q[0]) * y, cos(q[0]) * y - sin(q[0]) * x, z]
        obs = [clip(x, low - 0.5, high + 0.5) for x, (low, high) in zip(q, RANGES)]
        obs += [clip(self.speed(name), -10, 10) for name in DRIVEN]
        obs += [*[clip(x, -20, 20) for x in delta], clip(angle, -1.5 * pi, 1.5 * pi)]
        if options.get("sensors"):
            for command, low, high in zip(self.command, SLOWEST, FASTEST):
                obs.append(command / (high if command > 0 else -low))
            obs += [clip(self.speed(name), -10, 10) for name in ("q5", "q6")]
            obs += [self.spring(SERVOS.index(n)) / f for n, f in zip(DRIVEN, FORCE_LIMIT)]
        return obs

    def measure(self):
        centre, axis = self.log_pose()
        q1, q7, offset = self.joint("q1"), self.joint("q7"), self.options["offset"]
        self.delta, self.psi, _ = self.pose(centre, axis, q1, q7, offset)
        upright = min(abs(axis[2]), 1)
        lowest = 2.75 / 2 * upright + self.diameter / 2 * sqrt(1 - upright**2)
        grapple = self.data.site_xpos[self.site].tolist()
        miss = abs(sum((g - c) * a for g, c, a in zip(grapple, centre, axis)))
        info = {"d_combine": hypot(*self.delta) + self.psi, "clearance": centre[2] - lowest}
        info |= {"centre_miss": miss, "diameter": self.diameter, "log_mass": self.mass}
        info |= {"ground_peak": self.peak}
        if self.options.get("randomize"):
            info |= {f"drawn_{name}": drawn for name, drawn in self.drawn.items()}
        return info

    def touching(self):
        """Whether outer and inner jaw touch the log."""
        touched = set()
        for pair in self.data.contact.geom.tolist():
            one, other = (int(self.model.geom_bodyid[geom]) for geom in pair)
            touched |= {one, other} if self.log in (one, other) else set()
        return [jaw in touched for jaw in self.jaws]

    # ---- what comes of it

    def outcome(self):
        """The reward, and what `info` says."""
        info, time, held = self.measure(), self.steps * self.dt, all(self.touching())
        if info["d_combine"] < 0.35 and time < self.reach_time + 1e-9:
            self.reached_at = min(self.reached_at, time)
        self.carried = clip(1 - self.support / (self.mass * G), 0, 1)
        terms = self.staged(info, held) if self.options["reward"] == "staged" else self.paper(info)
        ending = self.ending(time)
        conditions = {"not_lifted": info["clearance"] >= 0.1, "not_held": held}
        conditions["off_centre"] = info["centre_miss"] <= 0.3
        if self.met:
            conditions = {name: met(self) for name, met in self.met.items()}
        needed, failed = int(self.hold_time / self.dt + 1e-9) + 1, []
        for name, ok in conditions.items():
            self.kept[name] = self.kept.get(name, 0) + 1 if ok else 0
            failed += [name] if self.kept[name] < needed else []
        info |= terms | {"time": time, "time_to_reach": self.reached_at, "safe": not failed}
        info["termination"] = ending
        self.costs["time_up"] = min(self.costs["time_up"], time) if not failed else inf
        if ending != "none":
            success = ending == "time_limit" and not failed
            info |= {"success": success, "is_success": success}
            info["gentle"] = success and self.peak <= 20e3
            info["failure"] = "" if success else failed[0] if ending == "time_limit" else ending
            self.successes.append(success)
            if not success:
                self.failed_starts.append((self.drawn_start, self.drawn))
        return sum(terms.values()), info

    def staged(self, info, held):
        x, y, z = self.delta
        far, miss = hypot(x, y, z + 0.1) + self.psi, info["centre_miss"]
        clear, q8 = max(info["clearance"], 1e-9), self.joint("q8")
        centred, closed = exp(-((miss / 0.25) ** 2)), q8 / 3
        grip, most, weight = centred, 1, 30
        if self.hydraulic:
            tips = self.data.site_xpos[self.site][2] + 0.5 - 0.8566 * sin(q8)
            depth = (self.log_pose()[0][2] - tips) / (self.diameter / 2)
            randomize = self.options.get("randomize", 0.0)
            pay = clip(1 + (1 + randomize) * (depth - 0.5), 0, 1)
            grip, closed = grip * pay, 1 if held else min(closed, 0.5)
            most, weight = 3, 90 / (1 + randomize)
        lift = grip * sqrt(min(clear, 1 / clear))
        return {
            "r_distance": exp(-far),
            "r_grapple": 2 * min(1, exp(-3 * (far - 0.35))) * exp(-((miss / 0.5) ** 2)) * closed,
            "r_lift": 2 * lift + centred * self.carried * held,
            "r_balance": 3 * (1 - tanh(hypot(*self.command[:5]))) * lift * held,
            "r_ground": -weight * self.difficulty**4 * clip(self.impact / 10e3 - 1, 0, most),
        }

    def paper(self, info):
        near, closed = exp(-info["d_combine"]), self.joint("q8") / 3
        grapple = near * closed + (1 - closed) * (1 - near)
        lift = (1 - tanh(abs(self.log_pose()[0][2] - 1))) * (1 - grapple)
        balance = (1 - tanh(hypot(*self.command))) * (1 - lift)
        return dict(r_distance=near, r_grapple=grapple, r_lift=lift, r_balance=balance)

    def ending(self, time):
        """The first rule that holds."""
        for name, (low, high) in zip(JOINTS[:7], RANGES):
            if not low - 0.02 <= self.joint(name) <= high + 0.02:
                return f"joint_limit_{name}"
        for name, low, high in zip(DRIVEN, SLOWEST, FASTEST):
            if not 2 * low <= self.speed(name) <= 2 * high:
                return "overspeed"
        if dist(self.log_pose()[0], self.data.site_xpos[self.site].tolist()) > 8:
            return "log_too_far"
        if time > self.reach_time - 1e-9 and self.reached_at == inf:
            return "not_reached"
        return "time_limit" if time > self.time_limit - 1e-9 else "none"

    def count_costs(self):
        """With the joints at the end of a physics step, and the forces that brought them there."""
        speeds, forces = [self.speed(name) for name in DRIVEN], [0.0] * 6
        for servo, i in zip(self.servos, OF_SERVO):
            forces[i] += float(self.data.qfrc_actuator[servo])
        oil = oil_of(self.joint("q2"), self.joint("q3"), speeds, forces[3])
        flow, pressure = sum(o * abs(v) for o, v in zip(oil, speeds)), 0.0
        for i, (v, force) in enumerate(zip(speeds, forces)):
            if abs(v) > 0.01 * min(-SLOWEST[i], FASTEST[i]):
                pressure = max(pressure, force * copysign(1, v) / oil[i])
        self.costs["litres"] += 1000 * flow * TIMESTEP
        self.costs["energy"] += flow * pressure * TIMESTEP
        plumb = pi / 2 - self.joint("q2") - self.joint("q3")
        swing = hypot(self.joint("q5") - plumb, self.joint("q6") - pi / 2)
        self.costs["swing_peak"] = max(self.costs["swing_peak"], swing)
