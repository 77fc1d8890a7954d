// The task of crane_env.py for one crane, in MuJoCo's WebAssembly build: ForestryCrane-v0, ideal
// servos, no errors. Names and numbers are those of crane_env.py, crane_task.py and machine.py.

const SERVOS = [0, 1, 2, 3, 4, 7, 8, 9]; // the engine's joints that a servo moves
const COMMAND_OF_SERVO = [0, 1, 2, 3, 3, 4, 5, 5];
const JOINTS = [0, 1, 2, 3, 5, 6, 7, 8]; // the engine's joints that are q1 ... q8
const ACTUATED = [0, 1, 2, 3, 7, 8]; // the engine's joints q1, q2, q3, q4, q7, q8
const SLOWEST = [0.764, 0.326, 0.344, 0.63, 2.12, 1.8]; // rad/s and m/s at -1
const FASTEST = [0.802, 0.239, 0.326, 0.4, 2.12, 1.8]; // and at +1
const TIMESTEP = 0.005;
const FRAME_SKIP = 20;
const ANTI_WINDUP = 5; // physics steps between two clamps of the servos' integrators
const LOG_LENGTH = 2.75;
const LOG_DENSITY = 650;
const D_MAX = 0.8;
const ROTATOR_MAX = 2.8;
const HOLD_DECISIONS = 6;
export const TIME_LIMIT = 9;

const MESHES = ["jaw_root.obj", "jaw_middle.obj", "jaw_tip.obj"];

// crane.xml with a log of another diameter (m).
export function withLog(xml, diameter) {
  const radius = diameter / 2;
  const mass = LOG_DENSITY * Math.PI * radius ** 2 * LOG_LENGTH;
  const across = (mass * (3 * radius ** 2 + LOG_LENGTH ** 2)) / 12;
  const along = (mass * radius ** 2) / 2;
  const changes = [
    ['mass="424.675"', `mass="${mass}"`],
    ['diaginertia="275.66 275.66 16.058"', `diaginertia="${across} ${across} ${along}"`],
    ['size="0.275 1.375"', `size="${radius} ${LOG_LENGTH / 2}"`],
    ['size="0.275 1.1"', `size="${radius} ${LOG_LENGTH / 2 - radius}"`],
  ];
  for (const [before, after] of changes) {
    if (!xml.includes(before)) throw new Error(`crane.xml has no ${before}`);
    xml = xml.replace(before, after);
  }
  return xml;
}

// A start of the full task, as crane_task.sample_start draws it: q1 ... q8, log x, y, yaw.
export function sampleStart(random = Math.random) {
  const uniform = (low, high) => low + (high - low) * random();
  for (;;) {
    const [q2, q3, q4] = [uniform(0.1, 1.0), uniform(-0.6, 0.8), uniform(0.05, 1.0)];
    const arm = 3.157 + 2 * q4;
    const out = -0.18 + 3.49288 * Math.cos(q2) - 0.3925 * Math.cos(q2 + q3) + arm * Math.sin(q2 + q3);
    const up = 3.5657 + 3.49288 * Math.sin(q2) - 0.3925 * Math.sin(q2 + q3) - arm * Math.cos(q2 + q3);
    if (out < 4.5 || out > 8 || up < 2.7 || up > 4.2 || q2 + q3 <= 0.05) continue;
    const [q1, azimuth] = [0, 1].map(() => uniform((-2 * Math.PI) / 3, -Math.PI / 3));
    const swing = [0, 1].map(() => uniform(-0.05, 0.05));
    const [q7, yaw] = [0, 1].map(() => uniform(-Math.PI / 2, Math.PI / 2));
    const [q8, radius] = [uniform(0.05, 0.6), uniform(5.5, 7.5)];
    const q = [q1, q2, q3, q4, Math.PI / 2 - q2 - q3 + swing[0], Math.PI / 2 + swing[1], q7, q8];
    return { q, log: [radius * Math.cos(azimuth), radius * Math.sin(azimuth), yaw] };
  }
}

const clip = (x, low, high) => Math.min(Math.max(x, low), high);
const halfTurn = (a) => a - Math.PI * Math.floor((a + Math.PI / 2) / Math.PI);
const wholeTurn = (a) => a - 2 * Math.PI * Math.floor((a + Math.PI) / (2 * Math.PI));

export class Crane {
  // mujoco: the loaded module. read(name) gives a file of assets/, as text.
  constructor(mujoco, read) {
    this.mujoco = mujoco;
    this.xml = read("crane.xml");
    mujoco.FS.mkdir("/crane");
    for (const name of MESHES) mujoco.FS.writeFile(`/crane/${name}`, read(name));
  }

  // A new episode with a log of this diameter (m), from a start as sampleStart gives it.
  reset(diameter, start = sampleStart()) {
    const { mujoco } = this;
    this.data?.delete();
    this.model?.delete();
    mujoco.FS.writeFile("/crane/crane.xml", withLog(this.xml, diameter));
    this.model = mujoco.MjModel.from_xml_path("/crane/crane.xml");
    this.data = new mujoco.MjData(this.model);
    const { model, data } = this;
    const gains = model.actuator_gainprm.length / model.nu;
    this.kp = SERVOS.map((_, i) => model.actuator_gainprm[(8 + i) * gains]);
    this.lead = SERVOS.map((j, i) => model.jnt_actfrcrange[2 * j + 1] / this.kp[i]);

    const [x, y, yaw] = start.log;
    const [cos, sin] = [Math.cos(yaw / 2) / Math.SQRT2, Math.sin(yaw / 2) / Math.SQRT2];
    JOINTS.forEach((j, i) => (data.qpos[j] = start.q[i]));
    data.qpos[4] = start.q[3];
    data.qpos[9] = start.q[7];
    data.qpos.set([x, y, diameter / 2, cos, -cos, -sin, sin], 10);
    mujoco.mj_forward(model, data);
    SERVOS.forEach((j, i) => (data.act[i] = data.qpos[j] + data.qfrc_bias[j] / this.kp[i]));
    this.diameter = diameter;
    this.steps = 0;
    this.streaks = [0, 0, 0];
    this.reached = this.up = Infinity;
    this.result = "";
    this.peak = 0;
    return this.observe();
  }

  // Physics steps under six actions in [-1, 1]; one decision has FRAME_SKIP of them.
  step(actions, count) {
    const { mujoco, model, data } = this;
    COMMAND_OF_SERVO.forEach((c, i) => {
      const a = clip(actions[c], -1, 1);
      data.ctrl[i] = data.ctrl[8 + i] = a < 0 ? a * SLOWEST[c] : a * FASTEST[c];
    });
    for (let k = 0; k < count; k++) {
      if (this.steps % ANTI_WINDUP === 0) {
        SERVOS.forEach((j, i) => {
          const [q, lead] = [data.qpos[j], this.lead[i]];
          data.act[i] = clip(data.act[i], q - lead, q + lead);
        });
      }
      mujoco.mj_step(model, data);
      this.peak = Math.max(this.peak, Math.hypot(...data.sensordata.slice(17, 20)));
      this.steps++;
    }
    if (this.steps % FRAME_SKIP === 0) this.judge();
  }

  get time() {
    return this.steps * TIMESTEP;
  }

  // Positions after the last step, as crane_env.py reads them.
  refresh() {
    const { mujoco, model, data } = this;
    mujoco.mj_fwdPosition(model, data);
    mujoco.mj_sensorPos(model, data);
    mujoco.mj_fwdVelocity(model, data);
    mujoco.mj_sensorVel(model, data);
  }

  // Delta_p [m] and the signed angle [rad] to the log.
  relativePose() {
    const { data, diameter } = this;
    const s = data.sensordata;
    const delta = [0, 1, 2].map((i) => s[6 + i] - s[i]);
    delta[2] += (D_MAX - diameter) / 2;
    const [gx, gy, length] = [s[3], s[4], Math.max(Math.hypot(s[9], s[10]), 1e-9)];
    const [lx, ly] = [s[9] / length, s[10] / length];
    const dot = gx * lx + gy * ly;
    let angle = halfTurn(Math.atan2(gx * ly - gy * lx, dot));
    const slew = wholeTurn(Math.atan2(s[7], s[6]) - data.qpos[0]);
    const rotator = data.qpos[7] + slew - angle;
    if (Math.abs(rotator) > ROTATOR_MAX) angle += Math.PI * Math.sign(rotator);
    return { delta, psi: 1 - Math.min(Math.abs(dot), 1), angle };
  }

  // The 18 numbers of ForestryCrane-v0.
  observe() {
    this.refresh();
    const { data } = this;
    const { delta, angle } = this.relativePose();
    const [cos, sin] = [Math.cos(data.qpos[0]), Math.sin(data.qpos[0])];
    const [x, y, z] = delta;
    return Float32Array.from([
      ...JOINTS.map((j) => data.qpos[j]),
      ...ACTUATED.map((j) => data.qvel[j]),
      cos * x + sin * y,
      cos * y - sin * x,
      z,
      angle,
    ]);
  }

  get clearance() {
    const s = this.data.sensordata;
    const up = Math.min(Math.abs(s[11]), 1);
    return s[8] - (LOG_LENGTH / 2) * up - (this.diameter / 2) * Math.sqrt(1 - up ** 2);
  }

  // The rule of success after each decision. result stays "" until the time is up. The rules that
  // end an episode early in crane_env.py (joint limits, overspeed, log too far) are not here.
  judge() {
    if (this.result) return;
    this.refresh();
    const s = this.data.sensordata;
    const { delta, psi } = this.relativePose();
    const miss = Math.abs([0, 1, 2].reduce((sum, i) => sum + (s[i] - s[6 + i]) * s[9 + i], 0));
    if (Math.hypot(...delta) + psi < 0.35) this.reached = Math.min(this.reached, this.time);
    const good = [this.clearance >= 0.1, s[12] > 0 && s[13] > 0, miss <= 0.3];
    this.streaks = this.streaks.map((n, i) => (good[i] ? n + 1 : 0));
    const safe = this.streaks.every((n) => n >= HOLD_DECISIONS);
    if (safe) this.up = Math.min(this.up, this.time);
    if (this.time < TIME_LIMIT - 1e-9) return;
    const failed = ["not lifted", "not held", "off centre"].find((_, i) => this.streaks[i] < 6);
    this.result = this.reached > 6 ? "not reached in 6 s" : failed ? failed : "success";
  }
}
