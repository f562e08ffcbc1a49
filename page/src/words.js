// An answer in words.
const mm = (metres) => `${(1e3 * metres).toFixed(Math.abs(metres) < 9.95e-3 ? 1 : 0)} mm`;
export const millimetres = mm;
export const degrees = (angle) => `${((180 / Math.PI) * angle).toFixed(1)}°`;
export const plain = (name) => name.replaceAll("_", " ");

const FLIP = Math.PI / 4; // [rad] of one motor of the arm at once
const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

// What is nearest to touching when all is met.
export function clear(question, { clearance, closest }) {
  if (!closest) return "All contacts are met; collision not checked.";
  const [one, other] = closest.map((name) => plain(question.called(name)));
  return `All contacts are met; ${one} and ${other} are nearest, ${mm(clearance)} apart.`;
}

// That the arm went another way; "": it did not. Motors count from one.
export function flip({ motors, about }, from, to) {
  let most = 0, motor = -1;
  for (const i of about.armMotors) {
    const turned = about.prismatic[i] ? 0 : Math.abs(to[i] - from[i]);
    if (turned > most) [most, motor] = [turned, i];
  }
  if (most < FLIP) return "";
  return `The arm changed its posture: motor ${motor + 1} (${motors[motor]}) turned by ${((180 / Math.PI) * most).toFixed(0)}°.`;
}

// Why contacts cannot be met, as far as it is known here.
export function reason(robot, question, answer, motors) {
  const { about, Status, fingers } = robot;
  if (answer.status === Status.COLLISION) {
    const [one, other] = answer.closest.map((name) => plain(question.called(name)));
    const depth = answer.clearance < 0 ? ` by ${mm(-answer.clearance)}` : "";
    return `All contacts are met, but ${one} touches ${other}${depth}; no other posture that is free was found.`;
  }
  const found = [];
  for (const { fingers: pair, most, least } of about.spans) {
    const [a, b] = pair, away = apart(question.points[a], question.points[b]);
    const names = `${plain(fingers[a])} and ${plain(fingers[b])} would be ${mm(away)} apart`;
    if (away > most) found.push([away - most, `${names}; ${mm(most)} was the most in 20,000 random postures`]);
    else if (away < least) found.push([least - away, `${names}; ${mm(least)} was the least in 20,000 random postures`]);
  }
  about.reach.forEach((reach, i) => {
    const away = Math.hypot(...question.points[i]);
    if (away > reach) {
      found.push([
        away - reach,
        `${plain(fingers[i])}'s contact is ${mm(away)} from the base; ${mm(reach)} was the most in 20,000 random postures`,
      ]);
    }
  });
  if (found.length) return `Out of reach: ${found.sort((x, y) => y[0] - x[0])[0][1]}.`;
  let worst = 0;
  answer.positionError.forEach((error, i) => {
    const off = (k) => (answer.positionError[k] || 0) / 5e-3 + (answer.angleError[k] || 0) / 0.0524;
    if (off(i) > off(worst)) worst = i;
  });
  const ends = motors.length ? `; at a limit: ${motors.slice(0, 3).map(plain).join(", ")}` : "";
  const turned = Number.isNaN(answer.angleError[worst]) ? "" : ` and ${degrees(answer.angleError[worst])}`;
  const miss = `${plain(fingers[worst])} misses by ${mm(answer.positionError[worst])}${turned}`;
  return `No posture was found that meets all contacts: at best ${miss}${ends}.`;
}
