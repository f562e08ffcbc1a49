// The page: arm and hand are solved while contacts or the object are dragged.
import * as THREE from "three";
import { COLORS, ContactMark, Knob, RobotBody, SolidGroup, matrixOf, poseOf } from "./bodies.js";
import { DragController } from "./drag.js";
import { Panel, copyText, note } from "./panel.js";
import { UndoHistory, address, questionFromAddress, robotOf } from "./history.js";
import { FREE, TargetSolver } from "./solver.js";
import { Viewport } from "./viewport.js";
import { plain, postureChange } from "./messages.js";

/* global ROBOTS */
const element = (id) => document.getElementById(id);
const vector = (numbers) => new THREE.Vector3(...numbers);
const UP = new THREE.Vector3(0, 0, 1);
const JUMP = 0.35; // step of a motor above which the motion is animated [rad or dm]
const STEP = { far: 5e-3, near: 1e-3, turn: Math.PI / 60 }; // of keys [m, rad]
const OBSTACLE_SIZE = [0.08, 0.08, 0.32]; // the obstacle [m]
const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");
const narrow = matchMedia("(max-width: 760px)");

// Shows an error over the 3D view.
function fail(words, error) {
  element("loading").hidden = false;
  element("loading").textContent = words;
  if (error) console.error(error);
}

function createViewport() {
  try {
    return new Viewport(element("canvas"));
  } catch (error) {
    fail("This page needs WebGL: enable hardware acceleration, or use another browser.");
    throw error;
  }
}

const viewport = createViewport();
const panel = new Panel(ROBOTS, (robot) => selectRobot(robot));
const undoHistory = new UndoHistory(() => {
  element("undo").disabled = !undoHistory.canUndo;
  element("redo").disabled = !undoHistory.canRedo;
});
const loaded = new Map();
const world = new THREE.Group();
const knob = new Knob();
viewport.scene.add(world);

// State of the page.
const now = {
  solving: null, robot: null, grasp: null, points: [], normals: [], moved: new THREE.Matrix4(),
  object: null, obstacle: null, answer: null, shown: null, start: null, selected: "object",
};

// Loads the script of a robot once; works from disk as well.
function load(robot) {
  if (!loaded.has(robot.name)) {
    const ready = new Promise((resolve, refuse) => {
      const script = document.createElement("script");
      script.src = robot.script;
      script.onload = resolve;
      script.onerror = () => refuse(new Error(`The file ${robot.script} is missing beside this page.`));
      document.head.append(script);
    }).then(() => {
      if (!globalThis.WebAssembly) throw new Error("The solver needs WebAssembly, which this browser does not support.");
      return TargetSolver.of(globalThis.casadiIkRobots[robot.name]);
    });
    ready.catch(() => loaded.delete(robot.name));
    loaded.set(robot.name, ready);
  }
  return loaded.get(robot.name);
}

// Shows a robot with a question, the question in an address, or its first grasp that is solved
// without a collision.
let wanted = "";
async function selectRobot(robot, question = null, hash = "") {
  wanted = robot.name;
  panel.chosen(robot.name);
  element("loading").hidden = false;
  element("loading").textContent = `Loading ${robot.title} (${(robot.size / 1e6).toFixed(1)} MB) …`;
  let solving;
  try {
    solving = await load(robot);
  } catch (error) {
    return fail(error.message, error);
  }
  if (wanted !== robot.name) return;
  element("loading").hidden = true;
  if (now.robot !== robot) {
    Object.assign(now, { solving, robot, answer: null, shown: null });
    now.body = new RobotBody(solving.robot);
    panel.robot(solving.robot);
  }
  const first = now.grasp === null;
  if (hash.includes("=")) {
    try {
      const read = questionFromAddress(hash, solving.robot);
      question = read && { ...read, robot: robot.name };
    } catch (error) {
      note(`The link cannot be read: ${error.message}.`, 20);
    }
  }
  const { grasps } = solving.robot.about;
  // A cup is the clearest example; robots without one begin with a grasp that collides with nothing.
  const cup = grasps.find((grasp) => grasp.object === "cup" && isFree(grasp));
  question ??= shippedQuestion(cup ?? grasps[Math.max(grasps.findIndex(isFree), 0)]);
  showQuestion(question);
  fitView();
  if (!question.kept || first) record();
}

// Returns true if a grasp is solved without a collision.
function isFree(grasp) {
  const flat = [grasp.points, grasp.normals].map((all) => all.map((v) => v ?? FREE));
  const object = grasp.solids.map((one) => ({ ...one, grasped: true }));
  const { solving } = now;
  return solving.solve(...flat, null, object).status === solving.robot.Status.SOLVED;
}

// Returns the question of a shipped grasp.
const shippedQuestion = ({ name, points, normals }) => ({
  robot: now.robot.name, grasp: name, points, normals, object: [0, 0, 0, 0], obstacle: null, q0: null,
});

// Returns the current question; the object's pose is its translation and its angle about z.
function question() {
  const m = now.moved.elements;
  return {
    robot: now.robot.name,
    grasp: now.grasp.name,
    points: now.points.map((p) => p?.toArray() ?? null),
    normals: now.normals.map((n) => n?.toArray() ?? null),
    object: [m[12], m[13], m[14], Math.atan2(m[1], m[0])],
    obstacle: now.obstacle?.solids[0].pose.slice(9) ?? null,
    q0: now.start && [...now.start],
  };
}

const record = (kind) => undoHistory.record(question(), kind);

// Shows a question.
function showQuestion(target) {
  const { robot } = now.solving, { grasps } = robot.about;
  now.grasp = grasps.find(({ name }) => name === target.grasp);
  element("grasp").value = String(grasps.indexOf(now.grasp));
  // Fingers without a point, or without a normal, are free.
  now.points = target.points.map((p) => p && vector(p));
  now.normals = target.normals.map((n) => n && vector(n).normalize());
  now.start = target.q0 && Float64Array.from(target.q0);
  const [x, y, z, turn] = target.object;
  now.moved = new THREE.Matrix4().makeTranslation(x, y, z).multiply(new THREE.Matrix4().makeRotationZ(turn));
  world.clear();
  now.object = new SolidGroup(now.grasp.solids.map((one) => ({ ...one, pose: [...one.pose] })), true);
  for (const one of now.object.solids) transformSolid(one, now.moved);
  now.obstacle = target.obstacle && createObstacle(target.obstacle);
  element("obstacle").checked = Boolean(now.obstacle);
  now.marks = robot.fingers.map((_, i) => new ContactMark(COLORS[i % COLORS.length]));
  world.add(now.body, now.object, ...now.marks, knob);
  if (now.obstacle) world.add(now.obstacle);
  document.title = `${now.grasp.object || "at home"} · ${now.robot.title} · casadi_ik`;
  listHandles();
  solve();
}

function createObstacle(at) {
  const kind = now.solving.robot.Kind.BOX, pose = poseOf(new THREE.Matrix4().makeTranslation(...at));
  return new SolidGroup([{ kind, shape: "BOX", size: OBSTACLE_SIZE, pose }], false);
}

// Fits the main view to hand and object, with the whole robot as an inset, or to the whole robot.
function fitView(whole = false) {
  now.body.place(now.answer.q, now.solving.solver);
  const { close: preferred, whole: far } = now.grasp.views, object = cornersOf(now.object);
  const all = [...now.body.corners(false), ...object];
  const hand = [...now.body.corners(true), ...object, ...contactPoints()];
  viewport.showsHand = !whole;
  element("inset").hidden = false;
  element("inset").className = whole ? "swap" : "inset";
  element("inset").firstElementChild.textContent = whole ? "Show the hand" : "whole robot";
  element("inset").setAttribute("aria-label", whole ? "Show the hand" : "Show the whole robot");
  const stands = now.obstacle ? origins(now.obstacle.solids) : [];
  const close = viewport.side(preferred, [...contactPoints(), ...object], now.body.parts.map(({ mesh }) => mesh));
  viewport.setInset(far, all);
  viewport.look(whole ? far : close, [...(whole ? all : hand), ...stands]);
  draw();
}

function cornersOf(things) {
  const found = [];
  things.updateMatrixWorld(true);
  for (const mesh of things.children) {
    const box = new THREE.Box3().setFromObject(mesh), { min, max } = box;
    for (let i = 0; i < 8; ++i) found.push(vector([i & 1 ? min.x : max.x, i & 2 ? min.y : max.y, i & 4 ? min.z : max.z]));
  }
  return found;
}

// Adds a post beside the hand, on the side away from the arm.
function addObstacle() {
  const goal = mean(contactPoints()), side = vector([0, 0, 0]).setFromMatrixColumn(viewport.camera.matrixWorld, 0).setZ(0).normalize();
  const arm = now.body.parts.filter(({ role }) => role === "arm").map(({ mesh }) => mesh.position);
  const middle = mean(arm.length ? arm : contactPoints());
  if (side.dot(middle.sub(goal)) > 0) side.negate();
  const reach = 0.1 + Math.max(...cornersOf(now.object).map((one) => one.sub(goal).dot(side)));
  now.obstacle = createObstacle(goal.addScaledVector(side, Math.max(reach, 0.16)).toArray());
  world.add(now.obstacle);
}

function allSolids() {
  const object = now.object.solids.map((one) => ({ ...one, grasped: true }));
  const obstacle = now.obstacle?.solids ?? [];
  return [...object, ...obstacle.map((one) => ({ ...one, grasped: false }))];
}

const contactPoints = () => now.points.filter(Boolean);
const targets = () => [now.points, now.normals].map((all) => all.map((v) => v?.toArray() ?? FREE));

// Solves the current question, starting from the last solution.
function solve() {
  const { solving } = now, parts = now.object.solids.length;
  const [points, normals] = targets();
  now.solvedFrom = now.start;
  const answer = solving.solve(points, normals, now.start, allSolids());
  now.answer = answer;
  if (answer.status === solving.robot.Status.SOLVED) now.start = answer.q;
  const called = (name) => {
    const number = /^solid (\d+)$/.exec(name);
    return number ? (Number(number[1]) < parts ? "the object" : "the obstacle") : name;
  };
  panel.answer(solving, { points, called }, answer);
  const flipped = now.shown ? postureChange(solving.robot, now.shown, answer.q) : "";
  if (flipped) note(flipped, 8);
  show(answer.q, flipped ? 900 : 320);
  clearTimeout(later);
  later = setTimeout(onIdle, 250);
}

// Runs when nothing moves: updates the address, and measures the time of a solve again, since the
// browser has compiled the solver by then.
let later = 0;
function onIdle() {
  if (drag.dragged) return;
  const { solving, answer } = now;
  history.replaceState(null, "", address(question()));
  const again = solving.measureTime(...targets(), now.solvedFrom);
  if (answer === now.answer) {
    Object.assign(answer, again);
    panel.time(answer);
  }
}

// Shows a configuration; large steps are animated for a number of milliseconds.
let animation = 0;
function show(q, whole) {
  cancelAnimationFrame(animation);
  const from = now.shown;
  const far = from ? Math.max(...q.map((value, i) => Math.abs(value - from[i]))) : 0;
  if (!from || far < JUMP || reducedMotion.matches) {
    now.shown = q;
    draw();
    return;
  }
  const begun = performance.now();
  const go = (time) => {
    const part = Math.min(Math.max((time - begun) / whole, 0), 1), s = part * part * (3 - 2 * part);
    now.shown = part < 1 ? q.map((value, i) => from[i] + s * (value - from[i])) : q;
    draw();
    if (part < 1) animation = requestAnimationFrame(go);
  };
  animation = requestAnimationFrame(go);
}

function draw() {
  const { solver, robot } = now.solving, { Status } = robot;
  const tips = solver.contacts(now.shown).points;
  now.body.place(now.shown, solver);
  const touching = now.answer.status === Status.COLLISION && now.shown === now.answer.q;
  now.body.mark(touching ? now.answer.closest : []);
  now.object.place();
  now.obstacle?.place();
  const chosen = drag.dragged?.name ?? now.selected;
  now.marks.forEach((mark, i) => {
    mark.visible = Boolean(now.points[i]);
    if (!mark.visible) return;
    const tip = vector(tips.slice(3 * i, 3 * i + 3));
    const size = viewport.metres(5, now.points[i]);
    mark.place(now.points[i], now.normals[i], tip, size, chosen === `point ${i}`);
  });
  const middle = mean(anchorPoints("object"));
  knob.place(middle, viewport.metres(chosen === "object" ? 13 : 11, middle), viewport.camera);
  viewport.draw();
}
viewport.controls.addEventListener("change", () => now.shown && draw());

// Returns the draggable items.
function handles() {
  if (!now.answer) return { points: [], meshes: [] };
  const points = [{ name: "object", at: mean(anchorPoints("object")), wide: 15 }];
  now.marks.forEach((mark, i) => {
    if (now.points[i]) points.push({ name: `point ${i}`, at: now.points[i] });
    if (now.normals[i]) points.push({ name: `normal ${i}`, at: mark.end });
  });
  const meshes = [{ name: "object", mesh: now.object }];
  if (now.obstacle) meshes.push({ name: "obstacle", mesh: now.obstacle });
  return { points, meshes };
}

function listHandles() {
  const { fingers } = now.solving.robot, names = ["object"];
  const words = [now.object.solids.length ? "the object" : "all contacts"];
  now.points.forEach((point, i) => {
    if (point) [names[names.length], words[words.length]] = [`point ${i}`, `contact ${i + 1}: ${plain(fingers[i])}`];
  });
  if (now.obstacle) [names[names.length], words[words.length]] = ["obstacle", "the obstacle"];
  if (!names.includes(now.selected)) now.selected = "object";
  panel.selectable(names, words);
  element("selected").value = now.selected;
}

function select(name) {
  now.selected = name;
  element("selected").value = name;
  const said = element("selected").selectedOptions[0]?.textContent;
  if (said) note(`Keys move ${said}.`);
  draw();
}

function transformSolid(solid, moved) {
  const matrix = matrixOf(solid.pose);
  solid.pose = poseOf(matrix.premultiply(moved));
}

function mean(points) {
  return points.reduce((all, one) => all.add(one), vector([0, 0, 0])).divideScalar(points.length);
}

const origins = (solids) => solids.map((one) => vector(one.pose.slice(9)));
// Returns the origins of an item's solids, or the contacts if it has none.
const anchorPoints = (what) => (now[what].solids.length ? origins(now[what].solids) : contactPoints());

// Returns the rotation about the vertical axis through a point.
function rotationAbout(middle, angle) {
  const moved = new THREE.Matrix4().makeTranslation(middle);
  moved.multiply(new THREE.Matrix4().makeRotationAxis(UP, angle));
  return moved.multiply(new THREE.Matrix4().makeTranslation(middle.clone().negate()));
}

// Moves the object with its contacts, or the obstacle.
function moveItem(what, moved) {
  for (const one of now[what].solids) transformSolid(one, moved);
  if (what !== "object") return;
  now.moved.premultiply(moved);
  for (const point of contactPoints()) point.applyMatrix4(moved);
  for (const normal of now.normals) normal?.transformDirection(moved);
}

function move(name, offset, screen) {
  const [what, number] = name.split(" "), i = Number(number);
  element("hint").hidden = true;
  if (!offset) {
    const chosen = what === "normal" ? `point ${i}` : name;
    now.selected = element("selected").value = chosen;
    if (now.answer) record();
    return draw();
  }
  if (what === "point") now.points[i].add(offset);
  else if (what === "normal") {
    const end = now.marks[i].end.clone().add(offset);
    now.normals[i].copy(end.sub(now.points[i]).normalize());
    now.marks[i].end = now.points[i].clone().addScaledVector(now.normals[i], now.marks[i].length);
  } else {
    const turning = what === "object" && (screen.shift || element("turn").checked);
    const middle = mean(anchorPoints(what));
    moveItem(what, turning ? rotationAbout(middle, 0.012 * screen.x) : new THREE.Matrix4().makeTranslation(offset));
  }
  // Solves at most once per frame.
  viewport.draw(solve);
}

// Directions of keys in the view: right, up, forward.
const KEY_DIRECTIONS = {
  ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0],
  PageUp: [0, 0, 1], PageDown: [0, 0, -1],
};
function onKey(event) {
  if (!now.answer || event.ctrlKey || event.metaKey || event.altKey) return;
  const { key } = event, name = now.selected, [what, number] = name.split(" "), i = Number(number);
  const sign = { "+": 1, "=": 1, "-": -1, "_": -1 }[key];
  if (key === "Escape") select("object");
  else if (key === "n" || key === "N") {
    const names = [...element("selected").options].map((one) => one.value);
    select(names[(names.indexOf(name) + 1) % names.length]);
  } else if (KEY_DIRECTIONS[key]) {
    const [x, y, z] = KEY_DIRECTIONS[key], size = event.shiftKey ? STEP.near : STEP.far;
    const right = vector([0, 0, 0]).setFromMatrixColumn(viewport.camera.matrixWorld, 0).setZ(0).normalize();
    const offset = right.clone().multiplyScalar(x).addScaledVector(UP, y).addScaledVector(UP.clone().cross(right), z);
    move(name, offset.multiplyScalar(size), { x: 0, shift: false });
    viewport.draw(() => (solve(), record(`keys ${name}`)));
  } else if (sign && what !== "obstacle") {
    if (what === "object") moveItem("object", rotationAbout(mean(anchorPoints("object")), sign * STEP.turn));
    else now.normals[i]?.applyAxisAngle(UP, sign * STEP.turn);
    viewport.draw(() => (solve(), record(`turn ${name}`)));
  } else return;
  event.preventDefault();
}

// Undoes or redoes a step.
function stepHistory(count) {
  const step = undoHistory.step(count);
  if (!step) return;
  const robot = ROBOTS.find(({ name }) => name === step.robot);
  if (robot !== now.robot) selectRobot(robot, { ...step, kept: true });
  else {
    const other = step.grasp !== now.grasp.name;
    showQuestion(step);
    if (other) fitView();
  }
}

function selectGrasp() {
  showQuestion(shippedQuestion(now.solving.robot.about.grasps[Number(element("grasp").value)]));
  fitView();
  record();
}

// Copies q as code: radians or degrees, prismatic joints in metres.
function copyAnswer() {
  const [form, unit] = element("format").value.split(" "), { motors, about } = now.solving.robot;
  const values = [...now.answer.q].map((value, i) => {
    const one = unit === "deg" && !about.prismatic[i] ? (180 / Math.PI) * value : value;
    return Number(one.toFixed(unit === "deg" ? 4 : 6));
  });
  const text = form === "list" ? `[${values.join(", ")}]`
    : `{${motors.map((name, i) => `${JSON.stringify(name)}: ${values[i]}`).join(", ")}}`;
  const solved = now.answer.status === now.solving.robot.Status.SOLVED;
  copyText(text, solved ? `q (${values.length} motors)` : "q (not a solution)");
}

// Theme: that of the system until it is chosen here.
const system = matchMedia("(prefers-color-scheme: dark)");
function paint(dark) {
  element("dark").checked = dark;
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  viewport.paint(dark);
}
system.addEventListener("change", () => paint(system.matches));
paint(system.matches);

function fold(folded) {
  document.body.classList.toggle("folded", folded);
  element("fold").textContent = folded ? "Show panel" : "Hide panel";
  element("fold").setAttribute("aria-expanded", String(!folded));
}
fold(narrow.matches);

const drag = new DragController(viewport, handles, move);
element("canvas").addEventListener("keydown", onKey);
element("grasp").addEventListener("change", selectGrasp);
element("reset").addEventListener("click", () => now.answer && selectGrasp());
element("undo").addEventListener("click", () => stepHistory(-1));
element("redo").addEventListener("click", () => stepHistory(1));
element("copy").addEventListener("click", () => now.answer && copyAnswer());
element("link").addEventListener("click", () => {
  if (!now.answer) return;
  history.replaceState(null, "", address(question()));
  copyText(location.href, "Link");
});
element("selected").addEventListener("change", (event) => select(event.target.value));
element("dark").addEventListener("change", (event) => paint(event.target.checked));
element("fold").addEventListener("click", () => fold(!document.body.classList.contains("folded")));
element("inset").addEventListener("click", () => now.answer && fitView(viewport.showsHand));
element("obstacle").addEventListener("change", (event) => {
  if (!now.answer) return;
  if (event.target.checked) {
    addObstacle();
    fitView(!viewport.showsHand);
  } else {
    now.obstacle?.removeFromParent();
    now.obstacle = null;
  }
  listHandles();
  solve();
  record();
});
addEventListener("keydown", (event) => {
  if (!(event.ctrlKey || event.metaKey) || event.altKey || !now.answer) return;
  const key = event.key.toLowerCase();
  if (key !== "z" && key !== "y") return;
  event.preventDefault();
  stepHistory(key === "y" || event.shiftKey ? 1 : -1);
});

// Shows the robot in the address, or the first one.
function openAddress() {
  const name = robotOf(location.hash), robot = ROBOTS.find((one) => one.name === name);
  if (name && !robot) note(`The link names the robot "${name.slice(0, 60)}", which is not on this page.`, 20);
  selectRobot(robot ?? ROBOTS[0], null, robot ? location.hash : "");
}
addEventListener("hashchange", openAddress);

// Interface for tests and tools.
globalThis.casadiIk = {
  now,
  viewport,
  under: (x, y) => drag.hitTest(x, y, "mouse")?.name ?? "",
  pixel: (name) => {
    const { points, meshes } = handles();
    const one = points.find((each) => each.name === name);
    if (one) return viewport.pixel(one.at);
    const { mesh } = meshes.find((each) => each.name === name);
    return viewport.pixel(mean(origins(mesh.solids)));
  },
};
openAddress();
