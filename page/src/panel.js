// The panel beside the 3D view.
import { COLORS } from "./bodies.js";
import { clearanceText, degrees, failureReason, millimetres, plain } from "./messages.js";

const MET = { position: 5e-3, angle: (3 * Math.PI) / 180 };
const element = (id) => document.getElementById(id);

export class Panel {
  constructor(robots, choose) {
    this.chips = robots.map((robot) => {
      const chip = document.createElement("button");
      chip.type = "button";
      chip.dataset.robot = robot.name;
      chip.append(robot.title);
      const small = document.createElement("small");
      small.textContent = `${robot.what} ·\u00a0${(robot.size / 1e6).toFixed(1)}\u00a0MB`;
      chip.append(small);
      chip.addEventListener("click", () => choose(robot));
      return chip;
    });
    element("robots").replaceChildren(...this.chips);
  }

  chosen(name) {
    for (const chip of this.chips) chip.setAttribute("aria-pressed", String(chip.dataset.robot === name));
  }

  robot({ about, fingers, motors }) {
    element("grasp").replaceChildren(
      ...about.grasps.map((grasp, i) => new Option(grasp.object || "at home", String(i))),
    );
    element("fingers").replaceChildren(
      ...fingers.map((name, i) => {
        const row = document.createElement("tr");
        row.innerHTML = `<td><i style="background:${COLORS[i % COLORS.length]}"></i></td><td></td><td></td><td></td>`;
        row.cells[0].append(plain(name));
        return row;
      }),
    );
    element("motors").replaceChildren(
      ...motors.map((name, i) => {
        const row = document.createElement("div");
        row.className = "motor";
        row.innerHTML = "<span></span><div class=bar><i></i></div><output></output>";
        row.firstChild.textContent = row.firstChild.title = `${i + 1} ${name}`;
        return row;
      }),
    );
  }

  // Lists the items that keys can move, by name and label.
  selectable(names, words) {
    element("selected").replaceChildren(...names.map((name, i) => new Option(words[i], name)));
  }

  answer(solving, question, answer) {
    const { robot } = solving, { Status, about, lower, upper } = robot;
    const solved = answer.status === Status.SOLVED, touches = answer.status === Status.COLLISION;
    const badge = element("status");
    badge.textContent = solved ? "solved" : touches ? "in collision" : "not reached";
    badge.className = `badge ${solved ? "good" : touches ? "warn" : "bad"}`;
    this.time(answer);
    const why = element("reason");
    why.className = solved ? "good" : "bad";
    why.textContent = solved
      ? clearanceText(question, answer)
      : failureReason(robot, question, answer, solving.motorsAtLimits(answer.q));
    [...element("fingers").rows].forEach((row, i) => {
      const off = answer.positionError[i], turned = answer.angleError[i];
      // Unconstrained errors are NaN.
      const good = !(off > MET.position * 1.000001) && !(turned > MET.angle * 1.000001);
      row.cells[1].textContent = Number.isNaN(off) ? "free" : millimetres(off);
      row.cells[2].textContent = Number.isNaN(turned) ? "free" : degrees(turned);
      row.cells[3].textContent = Number.isNaN(off) ? "" : good ? "✓" : "✗";
      row.cells[3].className = good ? "good" : "bad";
    });
    const judged = (solved || touches) && answer.closest;
    const names = judged ? judged.map((name) => plain(question.called(name))) : null;
    element("clearance").textContent = names ? `${millimetres(answer.clearance)}, ${names.join(" – ")}` : "collision not checked";
    const { iterations, restarts } = answer;
    element("iterations").textContent = `${iterations}, ${restarts} ${restarts === 1 ? "restart" : "restarts"}`;
    [...element("motors").children].forEach((row, i) => {
      const part = (answer.q[i] - lower[i]) / (upper[i] - lower[i]);
      row.children[1].firstChild.style.left = `${100 * Math.min(Math.max(part, 0), 1)}%`;
      row.children[1].classList.toggle("end", Math.min(part, 1 - part) < 1e-3);
      row.lastChild.textContent = about.prismatic[i] ? millimetres(answer.q[i]) : degrees(answer.q[i]);
    });
  }

  time({ time, solveCount }) {
    const digits = time < 100 ? 1 : 0;
    element("time").textContent = time < 1000 ? `${time.toFixed(digits)} µs` : `${(time / 1000).toFixed(1)} ms`;
    element("share").title = solveCount > 1 ? `Median over ${solveCount} solves of this target` : "One solve";
  }
}

// Shows a message below the verdict for some seconds.
let silence = 0;
export function note(text, seconds = 6) {
  element("note").textContent = text;
  clearTimeout(silence);
  silence = setTimeout(() => (element("note").textContent = ""), 1e3 * seconds);
}

// Copies a text to the clipboard; falls back to execCommand if the browser refuses.
export async function copyText(text, what) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const area = document.createElement("textarea");
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    if (!done) return note(`The browser does not allow copying: ${text}`, 60);
  }
  return note(`${what} copied.`);
}
