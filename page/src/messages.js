// Results in words.
const mm = (metres) => `${(1e3 * metres).toFixed(Math.abs(metres) < 9.95e-3 ? 1 : 0)} mm`;
export const millimetres = mm;
export const degrees = (angle) => `${((180 / Math.PI) * angle).toFixed(1)}°`;
export const plain = (name) => name.replaceAll("_", " ");

const FLIP = Math.PI / 4; // step of an arm motor that counts as another posture [rad]
const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

// Returns the clearance of a solution in words.
export function clearanceText(question, { clearance, closest }) {
  if (!closest) return "All contacts are met; collision not checked.";
  const [first, second] = closest.map((name) => plain(question.called(name)));
  return `All contacts are met; clearance ${mm(clearance)} between ${first} and ${second}.`;
}

// Returns a message if the arm changed its posture, or ""; motors count from 1.
export function postureChange({ motors, about }, from, to) {
  let most = 0, motor = -1;
  for (const i of about.armMotors) {
    const turned = about.prismatic[i] ? 0 : Math.abs(to[i] - from[i]);
    if (turned > most) [most, motor] = [turned, i];
  }
  if (most < FLIP) return "";
  return `The arm changed its posture: motor ${motor + 1} (${motors[motor]}) turned by ${((180 / Math.PI) * most).toFixed(0)}°.`;
}

// Returns why the contacts are not met, as far as it is known.
export function failureReason(robot, question, answer, motors) {
  const { about, Status, fingers } = robot;
  if (answer.status === Status.COLLISION) {
    const [first, second] = answer.closest.map((name) => plain(question.called(name)));
    const depth = answer.clearance < 0 ? ` by ${mm(-answer.clearance)}` : "";
    return `All contacts are met, but ${first} collides with ${second}${depth}; no collision-free posture was found.`;
  }
  const reasons = [];
  for (const { fingers: pair, most, least } of about.spans) {
    const [a, b] = pair, away = apart(question.points[a], question.points[b]);
    const names = `${plain(fingers[a])} and ${plain(fingers[b])} would be ${mm(away)} apart`;
    if (away > most) reasons.push([away - most, `${names}; the maximum of 20,000 random postures is ${mm(most)}`]);
    else if (away < least) reasons.push([least - away, `${names}; the minimum of 20,000 random postures is ${mm(least)}`]);
  }
  about.reach.forEach((reach, i) => {
    const away = Math.hypot(...question.points[i]);
    if (away > reach) {
      reasons.push([
        away - reach,
        `the contact of ${plain(fingers[i])} is ${mm(away)} from the base; the maximum of 20,000 random postures is ${mm(reach)}`,
      ]);
    }
  });
  if (reasons.length) return `Out of reach: ${reasons.sort((x, y) => y[0] - x[0])[0][1]}.`;
  let worst = 0;
  answer.positionError.forEach((error, i) => {
    const off = (k) => (answer.positionError[k] || 0) / 5e-3 + (answer.angleError[k] || 0) / 0.0524;
    if (off(i) > off(worst)) worst = i;
  });
  const ends = motors.length ? `; at a limit: ${motors.slice(0, 3).map(plain).join(", ")}` : "";
  const turned = Number.isNaN(answer.angleError[worst]) ? "" : ` and ${degrees(answer.angleError[worst])}`;
  const miss = `${plain(fingers[worst])} misses by ${mm(answer.positionError[worst])}${turned}`;
  return `No posture meets all contacts; best result: ${miss}${ends}.`;
}
