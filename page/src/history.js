// Undo history, and questions in the address of the page.

const JOIN_MS = 900; // time within which steps of one kind are joined, for repeated keys [ms]
const RESOLUTION = 1e-4; // of points [m], normals and motor positions in addresses

// Steps that can be undone; a step is a question as JSON.
export class UndoHistory {
  constructor(changed) {
    Object.assign(this, { steps: [], at: -1, kind: "", when: 0, changed });
  }

  record(step, kind = "") {
    const text = JSON.stringify(step), time = performance.now();
    if (text === this.steps[this.at]) return;
    const joins = kind && kind === this.kind && time - this.when < JOIN_MS;
    this.steps.splice(joins ? this.at : this.at + 1, Infinity, text);
    this.at = this.steps.length - 1;
    Object.assign(this, { kind, when: time });
    this.changed();
  }

  step(count) {
    if (!this.steps[this.at + count]) return null;
    this.at += count;
    this.kind = "";
    this.changed();
    return JSON.parse(this.steps[this.at]);
  }

  get canUndo() {
    return this.at > 0;
  }

  get canRedo() {
    return this.at < this.steps.length - 1;
  }
}

const rounded = (value) => String(Math.round(value / RESOLUTION) / Math.round(1 / RESOLUTION));
const list = (values) => values.map(rounded).join(",");
const rows = (all) => all.map((row) => (row ? list(row) : "free")).join(";");

// Returns a question as the fragment of an address.
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

// Returns the name of the robot in an address, or "".
export function robotOf(hash) {
  const text = hash.slice(1);
  return text.includes("=") ? new URLSearchParams(text).get("robot") ?? "" : decodeURIComponent(text);
}

// Returns the question in an address for a loaded robot; null if it names only a robot.
export function questionFromAddress(hash, { about, fingers, motors }) {
  const words = new URLSearchParams(hash.slice(1));
  const of = (key, read, otherwise) => (words.has(key) ? read(words.get(key), key) : otherwise);
  const grasp = about.grasps.find(({ name }) => name === words.get("grasp"));
  if (!words.has("grasp")) return null;
  if (!grasp) throw new Error(`grasp: found "${words.get("grasp").slice(0, 60)}": no such grasp`);
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
