// The motion of one trial in MuJoCo's WebAssembly build: node compare.js <trial.json>
//
// tests/test_play.py writes trial.json: diameter, start and actions of each decision. Printed is
// one JSON line: observations after each decision, and the result.

import { readFileSync } from "node:fs";

import loadMujoco from "@mujoco/mujoco";

import { Crane } from "./crane.js";

const trial = JSON.parse(readFileSync(process.argv[2], "utf8"));
const mujoco = await loadMujoco();
const read = (name) => readFileSync(new URL(`../../assets/${name}`, import.meta.url), "utf8");
const crane = new Crane(mujoco, read);
const observations = [Array.from(crane.reset(trial.diameter, trial.start))];
const begin = performance.now();
for (const actions of trial.actions) {
  crane.step(actions, 20);
  observations.push(Array.from(crane.observe()));
}
const microseconds = (1000 * (performance.now() - begin)) / crane.steps;
const { result, up, peak } = crane;
console.log(JSON.stringify({ observations, result, up, peak, microseconds }));
