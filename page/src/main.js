// The page: a robot that follows contacts.
import * as THREE from "three";
import { COLORS, ContactMark, Knob, RobotBody, Things, matrixOf, poseOf } from "./bodies.js";
import { Grip } from "./grip.js";
import { Panel, copied, note } from "./panel.js";
import { Past, address, asked, robotOf } from "./question.js";
import { FREE, Solving } from "./solving.js";
import { Stage } from "./stage.js";
import { flip, plain } from "./words.js";

/* global ROBOTS */
const by = (id) => document.getElementById(id);
const V = (numbers) => new THREE.Vector3(...numbers);
const UP = new THREE.Vector3(0, 0, 1);
const JUMP = 0.35; // [rad or dm] by which a motor moves at once, unless it is shown how it gets there
const STEP = { far: 5e-3, near: 1e-3, turn: Math.PI / 60 }; // of keys [m, rad]
const POST = [0.08, 0.08, 0.32]; // the obstacle [m]
const still = matchMedia("(prefers-reduced-motion: reduce)");
const narrow = matchMedia("(max-width: 760px)");

// What went wrong, where everybody sees it.
function fail(words, error) {
  by("loading").hidden = false;
  by("loading").textContent = words;
  if (error) console.error(error);
}

function madeStage() {
  try {
    return new Stage(by("canvas"));
  } catch (error) {
    fail("This browser shows no 3D graphics (WebGL). Please switch hardware acceleration on, or use another browser.");
    throw error;
  }
}

const stage = madeStage();
const panel = new Panel(ROBOTS, (robot) => choose(robot));
const past = new Past(() => {
  by("undo").disabled = !past.back;
  by("redo").disabled = !past.again;
});
const loaded = new Map();
const world = new THREE.Group();
const knob = new Knob();
stage.scene.add(world);

// Everything about what is shown now.
const now = {
  solving: null, robot: null, grasp: null, points: [], normals: [], moved: new THREE.Matrix4(),
  object: null, obstacle: null, answer: null, shown: null, start: null, selected: "object",
};

// A script of its own per robot, loaded once; from disk, too.
function load(robot) {
  if (!loaded.has(robot.name)) {
    const ready = new Promise((resolve, refuse) => {
      const script = document.createElement("script");
      script.src = robot.script;
      script.onload = resolve;
      script.onerror = () => refuse(new Error(`The file ${robot.script} is missing beside this page.`));
      document.head.append(script);
    }).then(() => {
      if (!globalThis.WebAssembly) throw new Error("This browser has no WebAssembly, which the solver needs.");
      return Solving.of(globalThis.casadiIkRobots[robot.name]);
    });
    ready.catch(() => loaded.delete(robot.name));
    loaded.set(robot.name, ready);
  }
  return loaded.get(robot.name);
}

// Shows a robot: what is to be asked of it (a question, or the address it is read from), or the
// first of its grasps that is solved with nothing touching.
let wanted = "";
async function choose(robot, question = null, hash = "") {
  wanted = robot.name;
  panel.chosen(robot.name);
  by("loading").hidden = false;
  by("loading").textContent = `Loading ${robot.title} (${(robot.size / 1e6).toFixed(1)} MB) …`;
  let solving;
  try {
    solving = await load(robot);
  } catch (error) {
    return fail(error.message, error);
  }
  if (wanted !== robot.name) return;
  by("loading").hidden = true;
  if (now.robot !== robot) {
    Object.assign(now, { solving, robot, answer: null, shown: null });
    now.body = new RobotBody(solving.robot);
    panel.robot(solving.robot);
  }
  const first = now.grasp === null;
  if (hash.includes("=")) {
    try {
      const read = asked(hash, solving.robot);
      question = read && { ...read, robot: robot.name };
    } catch (error) {
      note(`The link cannot be read: ${error.message}.`, 20);
    }
  }
  const { grasps } = solving.robot.about;
  question ??= asMade(grasps[Math.max(grasps.findIndex(isFree), 0)]);
  stand(question);
  lookAtAll();
  if (!question.kept || first) keep();
}

// Whether a grasp is solved with its object there, and nothing touching: the first such is shown.
function isFree(grasp) {
  const flat = [grasp.points, grasp.normals].map((all) => all.map((v) => v ?? FREE));
  const object = grasp.solids.map((one) => ({ ...one, grasped: true }));
  const { solving } = now;
  return solving.ask(...flat, null, object).status === solving.robot.Status.SOLVED;
}

// The question of a shipped grasp.
const asMade = ({ name, points, normals }) => ({
  robot: now.robot.name, grasp: name, points, normals, object: [0, 0, 0, 0], obstacle: null, q0: null,
});

// What is asked now, as numbers: the object as it was moved, and turned about the vertical.
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

const keep = (kind) => past.keep(question(), kind);

// Everything stands as a question says.
function stand(asked_) {
  const { robot } = now.solving, { grasps } = robot.about;
  now.grasp = grasps.find(({ name }) => name === asked_.grasp);
  by("grasp").value = String(grasps.indexOf(now.grasp));
  // A finger without a contact is free, and so is one without a normal in how it turns.
  now.points = asked_.points.map((p) => p && V(p));
  now.normals = asked_.normals.map((n) => n && V(n).normalize());
  now.start = asked_.q0 && Float64Array.from(asked_.q0);
  const [x, y, z, turn] = asked_.object;
  now.moved = new THREE.Matrix4().makeTranslation(x, y, z).multiply(new THREE.Matrix4().makeRotationZ(turn));
  world.clear();
  now.object = new Things(now.grasp.solids.map((one) => ({ ...one, pose: [...one.pose] })), true);
  for (const one of now.object.solids) shift(one, now.moved);
  now.obstacle = asked_.obstacle && post(asked_.obstacle);
  by("obstacle").checked = Boolean(now.obstacle);
  now.marks = robot.fingers.map((_, i) => new ContactMark(COLORS[i % COLORS.length]));
  world.add(now.body, now.object, ...now.marks, knob);
  if (now.obstacle) world.add(now.obstacle);
  document.title = `${now.grasp.object || "at home"} · ${now.robot.title} · casadi_ik`;
  offerHandles();
  solve();
}

function post(at) {
  const kind = now.solving.robot.Kind.BOX, pose = poseOf(new THREE.Matrix4().makeTranslation(...at));
  return new Things([{ kind, shape: "BOX", size: POST, pose }], false);
}

// The camera: hand and object fill the picture, the whole robot is in the corner; or the other way.
function lookAtAll(whole = false) {
  now.body.place(now.answer.q, now.solving.solver);
  const { close: preferred, whole: far } = now.grasp.views, object = cornersOf(now.object);
  const all = [...now.body.corners(false), ...object];
  const hand = [...now.body.corners(true), ...object, ...placed()];
  stage.near = !whole;
  by("inset").hidden = false;
  by("inset").className = whole ? "swap" : "inset";
  by("inset").firstElementChild.textContent = whole ? "Show the hand" : "whole robot";
  by("inset").setAttribute("aria-label", whole ? "Show the hand" : "Show the whole robot");
  const stands = now.obstacle ? places(now.obstacle.solids) : [];
  const close = stage.side(preferred, [...placed(), ...object], now.body.parts.map(({ mesh }) => mesh));
  stage.lookWhole(far, all);
  stage.look(whole ? far : close, [...(whole ? all : hand), ...stands]);
  draw();
}

function cornersOf(things) {
  const found = [];
  things.updateMatrixWorld(true);
  for (const mesh of things.children) {
    const box = new THREE.Box3().setFromObject(mesh), { min, max } = box;
    for (let i = 0; i < 8; ++i) found.push(V([i & 1 ? min.x : max.x, i & 2 ? min.y : max.y, i & 4 ? min.z : max.z]));
  }
  return found;
}

// An obstacle: a post beside the hand, where nothing is, in sight.
function put() {
  const goal = middleOf(placed()), side = V([0, 0, 0]).setFromMatrixColumn(stage.camera.matrixWorld, 0).setZ(0).normalize();
  const arm = now.body.parts.filter(({ role }) => role === "arm").map(({ mesh }) => mesh.position);
  const middle = middleOf(arm.length ? arm : placed());
  if (side.dot(middle.sub(goal)) > 0) side.negate();
  const reach = 0.1 + Math.max(...cornersOf(now.object).map((one) => one.sub(goal).dot(side)));
  now.obstacle = post(goal.addScaledVector(side, Math.max(reach, 0.16)).toArray());
  world.add(now.obstacle);
}

function solids() {
  const object = now.object.solids.map((one) => ({ ...one, grasped: true }));
  const obstacle = now.obstacle?.solids ?? [];
  return [...object, ...obstacle.map((one) => ({ ...one, grasped: false }))];
}

const placed = () => now.points.filter(Boolean);
const targets = () => [now.points, now.normals].map((all) => all.map((v) => v?.toArray() ?? FREE));

// Asks for what stands there now. Where the robot is is where the last solved answer was.
function solve() {
  const { solving } = now, parts = now.object.solids.length;
  const [points, normals] = targets();
  now.asked = now.start;
  const answer = solving.ask(points, normals, now.start, solids());
  now.answer = answer;
  if (answer.status === solving.robot.Status.SOLVED) now.start = answer.q;
  const called = (name) => {
    const number = /^solid (\d+)$/.exec(name);
    return number ? (Number(number[1]) < parts ? "the object" : "the obstacle") : name;
  };
  panel.answer(solving, { points, called }, answer);
  const flipped = now.shown ? flip(solving.robot, now.shown, answer.q) : "";
  if (flipped) note(flipped, 8);
  show(answer.q, flipped ? 900 : 320);
  clearTimeout(later);
  later = setTimeout(rest, 250);
}

// When nothing moves: the address says what is asked, and what a solve takes is told once more, as
// by then the browser has compiled it well.
let later = 0;
function rest() {
  if (grip.held) return;
  const { solving, answer } = now;
  history.replaceState(null, "", address(question()));
  const again = solving.timed(...targets(), now.asked);
  if (answer === now.answer) {
    Object.assign(answer, again);
    panel.time(answer);
  }
}

// The robot where it is to be; a jump is shown as a way, so many milliseconds long.
let under_way = 0;
function show(q, whole) {
  cancelAnimationFrame(under_way);
  const from = now.shown;
  const far = from ? Math.max(...q.map((value, i) => Math.abs(value - from[i]))) : 0;
  if (!from || far < JUMP || still.matches) {
    now.shown = q;
    draw();
    return;
  }
  const begun = performance.now();
  const go = (time) => {
    const part = Math.min(Math.max((time - begun) / whole, 0), 1), s = part * part * (3 - 2 * part);
    now.shown = part < 1 ? q.map((value, i) => from[i] + s * (value - from[i])) : q;
    draw();
    if (part < 1) under_way = requestAnimationFrame(go);
  };
  under_way = requestAnimationFrame(go);
}

function draw() {
  const { solver, robot } = now.solving, { Status } = robot;
  const tips = solver.contacts(now.shown).points;
  now.body.place(now.shown, solver);
  const touching = now.answer.status === Status.COLLISION && now.shown === now.answer.q;
  now.body.mark(touching ? now.answer.closest : []);
  now.object.place();
  now.obstacle?.place();
  const chosen = grip.held?.name ?? now.selected;
  now.marks.forEach((mark, i) => {
    mark.visible = Boolean(now.points[i]);
    if (!mark.visible) return;
    const tip = V(tips.slice(3 * i, 3 * i + 3));
    const size = stage.metres(5, now.points[i]);
    mark.place(now.points[i], now.normals[i], tip, size, chosen === `point ${i}`);
  });
  const middle = middleOf(standing("object"));
  knob.place(middle, stage.metres(chosen === "object" ? 13 : 11, middle), stage.camera);
  stage.draw();
}
stage.controls.addEventListener("change", () => now.shown && draw());

// What the pointer may take hold of.
function handles() {
  if (!now.answer) return { points: [], meshes: [] };
  const points = [{ name: "object", at: middleOf(standing("object")), wide: 15 }];
  now.marks.forEach((mark, i) => {
    if (now.points[i]) points.push({ name: `point ${i}`, at: now.points[i] });
    if (now.normals[i]) points.push({ name: `normal ${i}`, at: mark.end });
  });
  const meshes = [{ name: "object", mesh: now.object }];
  if (now.obstacle) meshes.push({ name: "obstacle", mesh: now.obstacle });
  return { points, meshes };
}

function offerHandles() {
  const { fingers } = now.solving.robot, names = ["object"];
  const words = [now.object.solids.length ? "the object" : "all contacts"];
  now.points.forEach((point, i) => {
    if (point) [names[names.length], words[words.length]] = [`point ${i}`, `contact ${i + 1}: ${plain(fingers[i])}`];
  });
  if (now.obstacle) [names[names.length], words[words.length]] = ["obstacle", "the obstacle"];
  if (!names.includes(now.selected)) now.selected = "object";
  panel.selectable(names, words);
  by("selected").value = now.selected;
}

function select(name) {
  now.selected = name;
  by("selected").value = name;
  const said = by("selected").selectedOptions[0]?.textContent;
  if (said) note(`Keys move ${said}.`);
  draw();
}

function shift(solid, moved) {
  const matrix = matrixOf(solid.pose);
  solid.pose = poseOf(matrix.premultiply(moved));
}

function middleOf(points) {
  return points.reduce((all, one) => all.add(one), V([0, 0, 0])).divideScalar(points.length);
}

const places = (solids) => solids.map((one) => V(one.pose.slice(9)));
// Of what has no solids the contacts.
const standing = (what) => (now[what].solids.length ? places(now[what].solids) : placed());

// About the vertical through the middle of something.
function turned(middle, angle) {
  const moved = new THREE.Matrix4().makeTranslation(middle);
  moved.multiply(new THREE.Matrix4().makeRotationAxis(UP, angle));
  return moved.multiply(new THREE.Matrix4().makeTranslation(middle.clone().negate()));
}

// Moves the object with its contacts, or the obstacle.
function carry(what, moved) {
  for (const one of now[what].solids) shift(one, moved);
  if (what !== "object") return;
  now.moved.premultiply(moved);
  for (const point of placed()) point.applyMatrix4(moved);
  for (const normal of now.normals) normal?.transformDirection(moved);
}

function move(name, by_, screen) {
  const [what, number] = name.split(" "), i = Number(number);
  by("hint").hidden = true;
  if (!by_) {
    const chosen = what === "normal" ? `point ${i}` : name;
    now.selected = by("selected").value = chosen;
    if (now.answer) keep();
    return draw();
  }
  if (what === "point") now.points[i].add(by_);
  else if (what === "normal") {
    const end = now.marks[i].end.clone().add(by_);
    now.normals[i].copy(end.sub(now.points[i]).normalize());
    now.marks[i].end = now.points[i].clone().addScaledVector(now.normals[i], now.marks[i].length);
  } else {
    const turning = what === "object" && (screen.shift || by("turn").checked);
    const middle = middleOf(standing(what));
    carry(what, turning ? turned(middle, 0.012 * screen.x) : new THREE.Matrix4().makeTranslation(by_));
  }
  // Once a frame, however many events there are.
  stage.draw(solve);
}

// Keys move what is selected as it is seen: to the sides, up and down, to and fro.
const WAYS = {
  ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0],
  PageUp: [0, 0, 1], PageDown: [0, 0, -1],
};
function nudge(event) {
  if (!now.answer || event.ctrlKey || event.metaKey || event.altKey) return;
  const { key } = event, name = now.selected, [what, number] = name.split(" "), i = Number(number);
  const sign = { "+": 1, "=": 1, "-": -1, "_": -1 }[key];
  if (key === "Escape") select("object");
  else if (key === "n" || key === "N") {
    const names = [...by("selected").options].map((one) => one.value);
    select(names[(names.indexOf(name) + 1) % names.length]);
  } else if (WAYS[key]) {
    const [x, y, z] = WAYS[key], size = event.shiftKey ? STEP.near : STEP.far;
    const right = V([0, 0, 0]).setFromMatrixColumn(stage.camera.matrixWorld, 0).setZ(0).normalize();
    const by_ = right.clone().multiplyScalar(x).addScaledVector(UP, y).addScaledVector(UP.clone().cross(right), z);
    move(name, by_.multiplyScalar(size), { x: 0, shift: false });
    stage.draw(() => (solve(), keep(`keys ${name}`)));
  } else if (sign && what !== "obstacle") {
    if (what === "object") carry("object", turned(middleOf(standing("object")), sign * STEP.turn));
    else now.normals[i]?.applyAxisAngle(UP, sign * STEP.turn);
    stage.draw(() => (solve(), keep(`turn ${name}`)));
  } else return;
  event.preventDefault();
}

// One step back or forward.
function go(by_) {
  const step = past.go(by_);
  if (!step) return;
  const robot = ROBOTS.find(({ name }) => name === step.robot);
  if (robot !== now.robot) choose(robot, { ...step, kept: true });
  else {
    const other = step.grasp !== now.grasp.name;
    stand(step);
    if (other) lookAtAll();
  }
}

function takeGrasp() {
  stand(asMade(now.solving.robot.about.grasps[Number(by("grasp").value)]));
  lookAtAll();
  keep();
}

// The answer as a program takes it: radians or degrees, what slides in metres.
function copyAnswer() {
  const [form, unit] = by("format").value.split(" "), { motors, about } = now.solving.robot;
  const values = [...now.answer.q].map((value, i) => {
    const one = unit === "deg" && !about.prismatic[i] ? (180 / Math.PI) * value : value;
    return Number(one.toFixed(unit === "deg" ? 4 : 6));
  });
  const text = form === "list" ? `[${values.join(", ")}]`
    : `{${motors.map((name, i) => `${JSON.stringify(name)}: ${values[i]}`).join(", ")}}`;
  const solved = now.answer.status === now.solving.robot.Status.SOLVED;
  copied(text, solved ? `q (${values.length} motors)` : "q, which does not solve this question,");
}

// Light or dark: as the system has it, until it is chosen here.
const system = matchMedia("(prefers-color-scheme: dark)");
function paint(dark) {
  by("dark").checked = dark;
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  stage.paint(dark);
}
system.addEventListener("change", () => paint(system.matches));
paint(system.matches);

function fold(folded) {
  document.body.classList.toggle("folded", folded);
  by("fold").textContent = folded ? "Show panel" : "Hide panel";
  by("fold").setAttribute("aria-expanded", String(!folded));
}
fold(narrow.matches);

const grip = new Grip(stage, handles, move);
by("canvas").addEventListener("keydown", nudge);
by("grasp").addEventListener("change", takeGrasp);
by("reset").addEventListener("click", () => now.answer && takeGrasp());
by("undo").addEventListener("click", () => go(-1));
by("redo").addEventListener("click", () => go(1));
by("copy").addEventListener("click", () => now.answer && copyAnswer());
by("link").addEventListener("click", () => {
  if (!now.answer) return;
  history.replaceState(null, "", address(question()));
  copied(location.href, "Link");
});
by("selected").addEventListener("change", (event) => select(event.target.value));
by("dark").addEventListener("change", (event) => paint(event.target.checked));
by("fold").addEventListener("click", () => fold(!document.body.classList.contains("folded")));
by("inset").addEventListener("click", () => now.answer && lookAtAll(stage.near));
by("obstacle").addEventListener("change", (event) => {
  if (!now.answer) return;
  if (event.target.checked) {
    put();
    lookAtAll(!stage.near);
  } else {
    now.obstacle?.removeFromParent();
    now.obstacle = null;
  }
  offerHandles();
  solve();
  keep();
});
addEventListener("keydown", (event) => {
  if (!(event.ctrlKey || event.metaKey) || event.altKey || !now.answer) return;
  const key = event.key.toLowerCase();
  if (key !== "z" && key !== "y") return;
  event.preventDefault();
  go(key === "y" || event.shiftKey ? 1 : -1);
});

// The robot that an address asks for, else the first.
function read() {
  const name = robotOf(location.hash), robot = ROBOTS.find((one) => one.name === name);
  if (name && !robot) note(`The link asks for the robot "${name.slice(0, 60)}", which is not on this page.`, 20);
  choose(robot ?? ROBOTS[0], null, robot ? location.hash : "");
}
addEventListener("hashchange", read);

// For whoever looks from outside: what is shown, and where.
globalThis.casadiIk = {
  now,
  stage,
  under: (x, y) => grip.under(x, y, "mouse")?.name ?? "",
  pixel: (name) => {
    const { points, meshes } = handles();
    const one = points.find((each) => each.name === name);
    if (one) return stage.pixel(one.at);
    const { mesh } = meshes.find((each) => each.name === name);
    return stage.pixel(middleOf(places(mesh.solids)));
  },
};
read();
