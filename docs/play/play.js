// A crane in the browser: physics by MuJoCo, picture by three.js, opponent by ONNX.

import loadMujoco from "mujoco";
import * as ort from "onnxruntime-web";
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

import { Crane, sampleStart } from "./crane.js";

const LEVERS = [["Q", "A"], ["W", "S"], ["E", "D"], ["R", "F"], ["T", "G"], ["U", "J"]];
const DECISION = 20; // physics steps
const ASSETS = "../../assets/";

// ---- picture

const renderer = new THREE.WebGLRenderer({ antialias: true });
renderer.shadowMap.enabled = true;
document.body.prepend(renderer.domElement);
const scene = new THREE.Scene();
scene.background = new THREE.Color(0xbcd6ee);
scene.fog = new THREE.Fog(0xbcd6ee, 40, 120);
const camera = new THREE.PerspectiveCamera(45, 1, 0.1, 300);
camera.up.set(0, 0, 1);
camera.position.set(6.2, -13, 5.2);
const controls = new OrbitControls(camera, renderer.domElement);
controls.target.set(0, -3.5, 1.5);
scene.add(new THREE.HemisphereLight(0xffffff, 0x556644, 1.6));
const sun = new THREE.DirectionalLight(0xfff4e0, 2.2);
sun.position.set(10, -18, 25);
sun.castShadow = true;
sun.shadow.mapSize.set(2048, 2048);
Object.assign(sun.shadow.camera, { left: -14, right: 14, top: 14, bottom: -14 });
scene.add(sun);

function resize() {
  renderer.setSize(window.innerWidth, window.innerHeight);
  camera.aspect = window.innerWidth / window.innerHeight;
  camera.updateProjectionMatrix();
}
window.addEventListener("resize", resize);
resize();

function plantForest() {
  const crown = new THREE.MeshLambertMaterial({ color: 0x24492a, flatShading: true });
  const trunk = new THREE.MeshLambertMaterial({ color: 0x40301f });
  for (let k = 0; k < 120; k++) {
    const angle = 2.4 * k; // the golden angle spreads them
    const distance = 20 + (k * 7) % 28;
    const [x, y, size] = [distance * Math.cos(angle), distance * Math.sin(angle), 10 + (k % 4) * 2];
    if (Math.abs(y) < 5) continue;
    const tree = new THREE.Group();
    tree.add(new THREE.Mesh(new THREE.CylinderGeometry(0.15, 0.2, 0.2 * size), trunk));
    tree.children[0].position.y = 0.1 * size;
    for (const [height, width, middle] of [[0.5, 0.2, 0.35], [0.45, 0.15, 0.6], [0.35, 0.1, 0.82]]) {
      const cone = new THREE.Mesh(new THREE.ConeGeometry(width * size, height * size, 8), crown);
      cone.position.y = middle * size;
      tree.add(cone);
    }
    tree.rotation.x = Math.PI / 2; // three.js has y up, MuJoCo z
    tree.position.set(x, y, 0);
    scene.add(tree);
  }
}
plantForest();

// A geom's shape, with MuJoCo's z axis where three.js has y.
function shapeOf(model, g, types) {
  const [a, b, c] = model.geom_size.slice(3 * g, 3 * g + 3);
  switch (model.geom_type[g]) {
    case types.mjGEOM_PLANE.value:
      return new THREE.PlaneGeometry(300, 300);
    case types.mjGEOM_BOX.value:
      return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
    case types.mjGEOM_CYLINDER.value:
      return new THREE.CylinderGeometry(a, a, 2 * b, 32).rotateX(Math.PI / 2);
    case types.mjGEOM_CAPSULE.value:
      return new THREE.CapsuleGeometry(a, 2 * b, 8, 24).rotateX(Math.PI / 2);
    case types.mjGEOM_MESH.value: {
      const mesh = model.geom_dataid[g];
      const [v, n] = [model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]];
      const [f, m] = [model.mesh_faceadr[mesh], model.mesh_facenum[mesh]];
      const shape = new THREE.BufferGeometry();
      const vertices = new Float32Array(model.mesh_vert.slice(3 * v, 3 * (v + n)));
      shape.setAttribute("position", new THREE.BufferAttribute(vertices, 3));
      shape.setIndex([...model.mesh_face.slice(3 * f, 3 * (f + m))]);
      shape.computeVertexNormals();
      return shape;
    }
  }
  return null;
}

let bodies = [];

function buildScene(mujoco, model) {
  for (const { mesh } of bodies) {
    scene.remove(mesh);
    mesh.geometry.dispose();
    mesh.material.dispose();
  }
  bodies = [];
  for (let g = 0; g < model.ngeom; g++) {
    const shape = model.geom_group[g] > 2 ? null : shapeOf(model, g, mujoco.mjtGeom);
    if (!shape) continue;
    const material = model.geom_matid[g];
    const from = material < 0 ? model.geom_rgba : model.mat_rgba;
    const at = 4 * (material < 0 ? g : material);
    const isGround = model.geom_type[g] === mujoco.mjtGeom.mjGEOM_PLANE.value;
    const isLog = model.geom_bodyid[g] === model.nbody - 1;
    const color = new THREE.Color(isGround ? 0x5f7038 : isLog ? 0x6b4d33 : 0xffffff);
    if (!isGround && !isLog) color.setRGB(...from.slice(at, at + 3), THREE.SRGBColorSpace);
    const mesh = new THREE.Mesh(shape, new THREE.MeshStandardMaterial({ color, roughness: 0.7 }));
    mesh.castShadow = !isGround;
    mesh.receiveShadow = true;
    mesh.matrixAutoUpdate = false;
    scene.add(mesh);
    bodies.push({ mesh, g });
  }
}

function draw(data) {
  for (const { mesh, g } of bodies) {
    const [x, y, z] = data.geom_xpos.slice(3 * g, 3 * g + 3);
    const r = data.geom_xmat.slice(9 * g, 9 * g + 9);
    mesh.matrix.set(r[0], r[1], r[2], x, r[3], r[4], r[5], y, r[6], r[7], r[8], z, 0, 0, 0, 1);
  }
  controls.update();
  renderer.render(scene, camera);
}

// ---- game

const held = new Set();
const first = location.hash === "#policy" ? "policy" : "you"; // .../docs/play/#policy
let [diameter, start, driver] = [0.5, sampleStart(), first];

async function text(name) {
  const answer = await fetch(ASSETS + name);
  if (!answer.ok) throw new Error(`${name}: serve the repository's root, not this folder`);
  return answer.text();
}

function show(crane) {
  const phase = crane.result || (crane.up < Infinity ? "holding" : "on the way");
  const rows = [
    ["log", `${crane.diameter.toFixed(1)} m`],
    ["driver", driver],
    ["time", `${crane.time.toFixed(1)} s`],
    ["log safely up", crane.up < Infinity ? `after ${crane.up.toFixed(1)} s` : ""],
    ["on the ground", `${(crane.peak / 1000).toFixed(0)} kN at most`],
    ["state", phase],
  ];
  const cells = rows.map(([name, value]) => `<tr><td>${name}</td><td>${value}</td></tr>`);
  document.getElementById("state").innerHTML = cells.join("");
}

async function main() {
  const files = {};
  for (const name of ["crane.xml", "jaw_root.obj", "jaw_middle.obj", "jaw_tip.obj"]) {
    files[name] = await text(name);
  }
  ort.env.wasm.numThreads = 1;
  const policy = await ort.InferenceSession.create("policy.onnx");
  const mujoco = await loadMujoco();
  const crane = new Crane(mujoco, (name) => files[name]);
  let again = true;

  window.addEventListener("keydown", (event) => {
    if (event.repeat || event.metaKey || event.ctrlKey) return;
    const key = event.key.length === 1 ? event.key.toUpperCase() : event.key;
    held.add(key);
    if (key === "P") driver = driver === "you" ? "policy" : "you";
    if (key === "Enter") start = sampleStart();
    if (key === "ArrowUp") diameter = Math.min(0.8, diameter + 0.1);
    if (key === "ArrowDown") diameter = Math.max(0.3, diameter - 0.1);
    if (["Enter", "Backspace", "ArrowUp", "ArrowDown"].includes(key)) again = true;
  });
  window.addEventListener("keyup", (event) => held.delete(event.key.toUpperCase()));
  window.addEventListener("blur", () => held.clear());

  let actions = new Float32Array(6);
  let [before, owed] = [performance.now(), 0];
  window.crane = crane; // for the console
  for (;;) {
    if (again) {
      // here and not in the key's handler: a decision may be waiting for the policy there
      again = false;
      crane.reset(diameter, start);
      buildScene(mujoco, crane.model);
    }
    const now = await new Promise(requestAnimationFrame);
    owed = Math.min(owed + (now - before) / 1000, 0.1); // seconds of physics; slow machines slow down
    before = now;
    while (owed >= 0.005) {
      if (crane.steps % DECISION === 0 && driver === "policy") {
        const input = new ort.Tensor("float32", crane.observe(), [1, 18]);
        actions = (await policy.run({ obs: input })).actions.data;
      } else if (driver === "you") {
        actions = LEVERS.map(([up, down]) => Number(held.has(up)) - Number(held.has(down)));
      }
      crane.step(actions, 1);
      owed -= 0.005;
    }
    crane.refresh();
    draw(crane.data);
    show(crane);
  }
}

main().catch((error) => {
  document.getElementById("state").textContent = `${error.message}; see docs/play/README.md`;
  throw error;
});
