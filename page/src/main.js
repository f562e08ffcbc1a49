// The page: a robot that follows contacts.
import * as THREE from "three";
import { COLORS, ContactMark, RobotBody, Things, matrixOf, poseOf } from "./bodies.js";
import { Grip } from "./grip.js";
import { Panel } from "./panel.js";
import { FREE, Solving } from "./solving.js";
import { Stage } from "./stage.js";

/* global ROBOTS */
const by = (id) => document.getElementById(id);
const V = (numbers) => new THREE.Vector3(...numbers);
const UP = new THREE.Vector3(0, 0, 1);
const JUMP = 0.35; // [rad or dm] by which a motor moves at once, unless it is shown how it gets there
const still = matchMedia("(prefers-reduced-motion: reduce)");

const stage = new Stage(by("canvas"));
const panel = new Panel(ROBOTS, choose);
const loaded = new Map();
const world = new THREE.Group();
stage.scene.add(world);

// Everything about what is shown now.
const now = { solving: null, points: [], normals: [], object: null, obstacle: null, answer: null, shown: null };

// A script of its own per robot, loaded once; from disk, too.
function load(robot) {
  if (!loaded.has(robot.name)) {
    const ready = new Promise((resolve, fail) => {
      const script = document.createElement("script");
      script.src = robot.script;
      script.onload = resolve;
      script.onerror = () => fail(new Error(`${robot.script} cannot be loaded`));
      document.head.append(script);
    }).then(() => Solving.of(globalThis.casadiIkRobots[robot.name]));
    ready.catch(() => loaded.delete(robot.name));
    loaded.set(robot.name, ready);
  }
  return loaded.get(robot.name);
}

let wanted = "";
async function choose(robot) {
  wanted = robot.name;
  panel.chosen(robot.name);
  by("loading").hidden = false;
  by("loading").textContent = `loading ${robot.title} (${(robot.size / 1e6).toFixed(1)} MB) …`;
  let solving;
  try {
    solving = await load(robot);
  } catch (error) {
    by("loading").textContent = error.message;
    console.error(error);
    return;
  }
  if (wanted !== robot.name) return;
  by("loading").hidden = true;
  now.solving = solving;
  panel.robot(solving.robot);
  take(Math.max(solving.robot.about.grasps.findIndex(isFree), 0), true);
}

// Whether a grasp is solved with its object there, and nothing touching: the first such is shown.
function isFree(grasp) {
  const flat = [grasp.points, grasp.normals].map((all) => all.map((v) => v ?? FREE));
  const object = grasp.solids.map((one) => ({ ...one, grasped: true }));
  const { solving } = now;
  return solving.ask(...flat, null, object).status === solving.robot.Status.SOLVED;
}

// A shipped grasp, as it was made.
function take(number, look) {
  const { robot, solver } = now.solving, grasp = robot.about.grasps[number];
  by("grasp").value = String(number);
  // A finger without a contact is free, and so is one without a normal in how it turns.
  now.points = grasp.points.map((p) => p && V(p));
  now.normals = grasp.normals.map((n) => n && V(n).normalize());
  now.start = now.answer = null;
  world.clear();
  now.body = new RobotBody(robot.shapes, robot.about.arm, solver.shapes(robot.home));
  now.object = new Things(grasp.solids.map((one) => ({ ...one, pose: [...one.pose] })), true);
  now.marks = robot.fingers.map((_, i) => new ContactMark(COLORS[i % COLORS.length]));
  world.add(now.body, now.object, ...now.marks);
  now.shown = null;
  now.obstacle = null;
  solve();
  if (by("obstacle").checked) put();
  if (look) lookAtAll();
}

// The camera, so that robot and object fill the picture.
function lookAtAll() {
  const box = new THREE.Box3();
  for (const { mesh } of now.body.parts) box.expandByPoint(mesh.position);
  for (const point of placed()) box.expandByPoint(point);
  const ball = box.getBoundingSphere(new THREE.Sphere());
  const goal = middleOf(placed());
  // Hand and object are small beside an arm: they are nearer to the middle than it is.
  stage.look(ball.center.lerp(goal, 0.25), 0.98 * ball.radius, Math.min(box.min.z, 0), goal);
  draw();
}

// An obstacle: a post beside the middle of the arm, where nothing is.
function put() {
  const kind = now.solving.robot.Kind.BOX, arm = new Set(now.solving.robot.about.arm);
  const held = now.body.parts.filter((part) => arm.has(part.link)).map((part) => part.mesh.position);
  const middle = held[Math.floor(held.length / 2)] ?? placed()[0];
  const goal = middleOf(placed()), side = V([goal.y, -goal.x, 0]).normalize();
  if (side.dot(stage.camera.position.clone().sub(goal)) < 0) side.negate();
  const at = middle.clone().lerp(goal, 0.35).addScaledVector(side, 0.26);
  const turn = new THREE.Matrix4().makeTranslation(at);
  now.obstacle = new Things([{ kind, shape: "BOX", size: [0.08, 0.08, 0.32], pose: poseOf(turn) }], false);
  world.add(now.obstacle);
  solve();
}

function solids() {
  const object = now.object.solids.map((one) => ({ ...one, grasped: true }));
  const obstacle = now.obstacle?.solids ?? [];
  return [...object, ...obstacle.map((one) => ({ ...one, grasped: false }))];
}

const placed = () => now.points.filter(Boolean);
const question = () => [now.points, now.normals].map((all) => all.map((v) => v?.toArray() ?? FREE));

// Asks for what stands there now. Where the robot is is where the last solved answer was.
function solve() {
  const { solving } = now, parts = now.object.solids.length;
  const [points, normals] = question();
  now.asked = now.start;
  const answer = solving.ask(points, normals, now.start, solids());
  now.answer = answer;
  if (answer.status === solving.robot.Status.SOLVED) now.start = answer.q;
  const called = (name) => {
    const number = /^solid (\d+)$/.exec(name);
    return number ? (Number(number[1]) < parts ? "the object" : "the obstacle") : name;
  };
  panel.answer(solving, { points, called }, answer);
  show(answer.q);
  clearTimeout(later);
  later = setTimeout(measure, 250);
}

// What a solve takes is told once more when nothing moves: by then the browser has compiled it well.
let later = 0;
function measure() {
  if (grip.held) return;
  const { solving, answer } = now, again = solving.timed(...question(), now.asked);
  if (answer === now.answer) {
    Object.assign(answer, again);
    panel.time(answer);
  }
}

// The robot where it is to be; a jump is shown as a way.
let under_way = 0;
function show(q) {
  cancelAnimationFrame(under_way);
  const from = now.shown;
  const far = from ? Math.max(...q.map((value, i) => Math.abs(value - from[i]))) : 0;
  if (!from || far < JUMP || still.matches) {
    now.shown = q;
    draw();
    return;
  }
  const begun = performance.now(), whole = 320;
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
  now.body.place(solver.shapes(now.shown));
  const touching = now.answer.status === Status.COLLISION && now.shown === now.answer.q;
  now.body.mark(touching ? now.answer.closest : []);
  now.object.place();
  now.obstacle?.place();
  now.marks.forEach((mark, i) => {
    mark.visible = Boolean(now.points[i]);
    if (!mark.visible) return;
    const tip = V(tips.slice(3 * i, 3 * i + 3)), held = grip.held?.name;
    const size = stage.metres(8, now.points[i]);
    mark.place(now.points[i], now.normals[i], tip, size, held === `point ${i}`);
  });
  stage.draw();
}
stage.controls.addEventListener("change", () => now.shown && draw());

// What the pointer may take hold of.
function handles() {
  if (!now.answer) return { points: [], meshes: [] };
  const points = [];
  now.marks.forEach((mark, i) => {
    if (now.points[i]) points.push({ name: `point ${i}`, at: now.points[i] });
    if (now.normals[i]) points.push({ name: `normal ${i}`, at: mark.end });
  });
  const meshes = [{ name: "object", mesh: now.object }];
  if (now.obstacle) meshes.push({ name: "obstacle", mesh: now.obstacle });
  return { points, meshes };
}

function shift(solid, moved) {
  const matrix = matrixOf(solid.pose);
  solid.pose = poseOf(matrix.premultiply(moved));
}

function middleOf(points) {
  return points.reduce((all, one) => all.add(one), V([0, 0, 0])).divideScalar(points.length);
}

const places = (solids) => solids.map((one) => V(one.pose.slice(9)));

function move(name, by_, screen) {
  if (!by_) return draw();
  const [what, number] = name.split(" "), i = Number(number);
  if (what === "point") now.points[i].add(by_);
  else if (what === "normal") {
    const end = now.marks[i].end.clone().add(by_);
    now.normals[i].copy(end.sub(now.points[i]).normalize());
    now.marks[i].end = now.points[i].clone().addScaledVector(now.normals[i], now.marks[i].length);
  } else {
    const solids = now[what].solids;
    const turning = what === "object" && (screen.shift || by("turn").checked);
    let moved = new THREE.Matrix4().makeTranslation(by_);
    if (turning) {
      const middle = middleOf(places(solids));
      moved = new THREE.Matrix4().makeTranslation(middle);
      moved.multiply(new THREE.Matrix4().makeRotationAxis(UP, 0.012 * screen.x));
      moved.multiply(new THREE.Matrix4().makeTranslation(middle.negate()));
    }
    for (const one of solids) shift(one, moved);
    if (what === "object") {
      for (const point of placed()) point.applyMatrix4(moved);
      for (const normal of now.normals) normal?.transformDirection(moved);
    }
  }
  // Once a frame, however many events there are.
  stage.draw(solve);
}

const grip = new Grip(stage, handles, move);
by("grasp").addEventListener("change", (event) => take(Number(event.target.value), false));
by("reset").addEventListener("click", () => take(Number(by("grasp").value), true));
by("obstacle").addEventListener("change", (event) => {
  if (event.target.checked) return put();
  now.obstacle?.removeFromParent();
  now.obstacle = null;
  return solve();
});

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
choose(ROBOTS.find((robot) => `#${robot.name}` === location.hash) ?? ROBOTS[0]);
