// What is asked: remembered step by step, and as the address of the page has it.

const AT_ONCE = 900; // [ms] in which steps of one kind are one step: keys that are held
const ROUND = 1e-4; // [m], and of normals and positions of motors

// Steps that can be taken back. A step is whatever was asked, as JSON has it.
export class Past {
  constructor(changed) {
    Object.assign(this, { steps: [], at: -1, kind: "", when: 0, changed });
  }

  keep(step, kind = "") {
    const text = JSON.stringify(step), time = performance.now();
    if (text === this.steps[this.at]) return;
    const joins = kind && kind === this.kind && time - this.when < AT_ONCE;
    this.steps.splice(joins ? this.at : this.at + 1, Infinity, text);
    this.at = this.steps.length - 1;
    Object.assign(this, { kind, when: time });
    this.changed();
  }

  go(by) {
    if (!this.steps[this.at + by]) return null;
    this.at += by;
    this.kind = "";
    this.changed();
    return JSON.parse(this.steps[this.at]);
  }

  get back() {
    return this.at > 0;
  }

  get again() {
    return this.at < this.steps.length - 1;
  }
}

const rounded = (value) => String(Math.round(value / ROUND) / Math.round(1 / ROUND));
const list = (values) => values.map(rounded).join(",");
const rows = (all) => all.map((row) => (row ? list(row) : "free")).join(";");

// A question as the part of an address behind "#".
export function address({ robot, grasp, points, normals, object, obstacle, q0 }) {
  const words = { robot, grasp, points: rows(points), normals: rows(normals), object: list(object) };
  if (obstacle) words.obstacle = list(obstacle);
  if (q0) words.q0 = list(q0);
  const written = Object.entries(words).map(([key, value]) => `${key}=${encodeURIComponent(value)}`);
  return `#${written.join("&").replaceAll("%2C", ",").replaceAll("%3B", ";")}`;
}

function numbers(text, count, key) {
  const found = text.split(",").map((word) => (word.trim() ? Number(word) : NaN));
  if (found.length !== count || !found.every((value) => Math.abs(value) < 100)) {
    throw new Error(`${key}: found "${text.slice(0, 60)}", expected ${count} numbers`);
  }
  return found;
}

function contacts(text, count, key) {
  const found = text.split(";");
  if (found.length !== count) throw new Error(`${key}: found ${found.length} of the ${count} fingers`);
  return found.map((row) => (row === "free" ? null : numbers(row, 3, key)));
}

// The name of the robot of an address; "": it has none.
export function robotOf(hash) {
  const text = hash.slice(1);
  return text.includes("=") ? new URLSearchParams(text).get("robot") ?? "" : decodeURIComponent(text);
}

// The question of an address, of a robot that is loaded; null: it has only a robot.
export function asked(hash, { about, fingers, motors }) {
  const words = new URLSearchParams(hash.slice(1));
  const of = (key, read, otherwise) => (words.has(key) ? read(words.get(key), key) : otherwise);
  const grasp = about.grasps.find(({ name }) => name === words.get("grasp"));
  if (!words.has("grasp")) return null;
  if (!grasp) throw new Error(`grasp: found "${words.get("grasp").slice(0, 60)}", which is not here`);
  const f = fingers.length;
  const points = of("points", (text, key) => contacts(text, f, key), grasp.points);
  const normals = of("normals", (text, key) => contacts(text, f, key), grasp.normals);
  if (!points.some(Boolean)) throw new Error("points: all are free");
  if (normals.some((normal) => normal && Math.hypot(...normal) < 1e-6)) throw new Error("normals: one is zero");
  return {
    robot: about.name, grasp: grasp.name, points, normals,
    object: of("object", (text, key) => numbers(text, 4, key), [0, 0, 0, 0]),
    obstacle: of("obstacle", (text, key) => numbers(text, 3, key), null),
    q0: of("q0", (text, key) => numbers(text, motors.length, key), null),
  };
}
