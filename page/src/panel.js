// What is said beside the picture.
import { COLORS } from "./bodies.js";
import { clear, degrees, millimetres, plain, reason } from "./words.js";

const MET = { position: 5e-3, angle: (3 * Math.PI) / 180 };
const by = (id) => document.getElementById(id);

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
    by("robots").replaceChildren(...this.chips);
  }

  chosen(name) {
    for (const chip of this.chips) chip.setAttribute("aria-pressed", String(chip.dataset.robot === name));
  }

  robot({ about, fingers, motors }) {
    by("grasp").replaceChildren(
      ...about.grasps.map((grasp, i) => new Option(grasp.object || "at home", String(i))),
    );
    by("fingers").replaceChildren(
      ...fingers.map((name, i) => {
        const row = document.createElement("tr");
        row.innerHTML = `<td><i style="background:${COLORS[i % COLORS.length]}"></i></td><td></td><td></td><td></td>`;
        row.cells[0].append(plain(name));
        return row;
      }),
    );
    by("motors").replaceChildren(
      ...motors.map((name, i) => {
        const row = document.createElement("div");
        row.className = "motor";
        row.innerHTML = "<span></span><div class=bar><i></i></div><output></output>";
        row.firstChild.textContent = row.firstChild.title = `${i + 1} ${name}`;
        return row;
      }),
    );
  }

  // What keys may move, by name and in words.
  selectable(names, words) {
    by("selected").replaceChildren(...names.map((name, i) => new Option(words[i], name)));
  }

  answer(solving, question, answer) {
    const { robot } = solving, { Status, about, lower, upper } = robot;
    const solved = answer.status === Status.SOLVED, touches = answer.status === Status.COLLISION;
    const badge = by("status");
    badge.textContent = solved ? "solved" : touches ? "touches" : "not reached";
    badge.className = `badge ${solved ? "good" : touches ? "warn" : "bad"}`;
    this.time(answer);
    const why = by("reason");
    why.className = solved ? "good" : "bad";
    why.textContent = solved ? clear(question, answer) : reason(robot, question, answer, solving.atEnds(answer.q));
    [...by("fingers").rows].forEach((row, i) => {
      const off = answer.positionError[i], turned = answer.angleError[i];
      // What is free is NaN.
      const good = !(off > MET.position * 1.000001) && !(turned > MET.angle * 1.000001);
      row.cells[1].textContent = Number.isNaN(off) ? "free" : millimetres(off);
      row.cells[2].textContent = Number.isNaN(turned) ? "free" : degrees(turned);
      row.cells[3].textContent = Number.isNaN(off) ? "" : good ? "✓" : "✗";
      row.cells[3].className = good ? "good" : "bad";
    });
    const judged = (solved || touches) && answer.closest;
    const names = judged ? judged.map((name) => plain(question.called(name))) : null;
    by("clearance").textContent = names ? `${millimetres(answer.clearance)}, ${names.join(" – ")}` : "collision not checked";
    const { iterations, restarts } = answer;
    by("iterations").textContent = `${iterations}, ${restarts} ${restarts === 1 ? "restart" : "restarts"}`;
    [...by("motors").children].forEach((row, i) => {
      const part = (answer.q[i] - lower[i]) / (upper[i] - lower[i]);
      row.children[1].firstChild.style.left = `${100 * Math.min(Math.max(part, 0), 1)}%`;
      row.children[1].classList.toggle("end", Math.min(part, 1 - part) < 1e-3);
      row.lastChild.textContent = about.prismatic[i] ? millimetres(answer.q[i]) : degrees(answer.q[i]);
    });
  }

  time({ time, counted }) {
    const digits = time < 100 ? 1 : 0;
    by("time").textContent = time < 1000 ? `${time.toFixed(digits)} µs` : `${(time / 1000).toFixed(1)} ms`;
    by("share").title = counted > 1 ? `Median over lots of ${counted} solves of this target in all` : "One solve";
  }
}

// Something that happened, said below the verdict, where there is always room for it.
let silence = 0;
export function note(text, seconds = 6) {
  by("note").textContent = text;
  clearTimeout(silence);
  silence = setTimeout(() => (by("note").textContent = ""), 1e3 * seconds);
}

// Text to the clipboard; where the browser does not let a page do that, the old way.
export async function copied(text, what) {
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
