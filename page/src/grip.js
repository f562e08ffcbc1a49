// A hand on the picture: what is under the pointer, and where it is dragged to.
import * as THREE from "three";

// How far from what is seen it is taken hold of [pixels]: at once, and where nothing else is.
const NEAR = { mouse: [8, 16], pen: [10, 20], touch: [14, 30] };
const AROUND = [[0, 0], [9, 0], [-9, 0], [0, 9], [0, -9]];

// Watches the pointer. `handles` gives what can be taken: points that are seen, { at, name, wide },
// and meshes, { mesh, name }; `move` is told the name, how far it went [m] and how far on the screen.
export class Grip {
  constructor(stage, handles, move) {
    Object.assign(this, { stage, handles, move });
    this.held = null;
    const canvas = stage.canvas;
    // Before the camera's own listeners, which then do nothing.
    canvas.addEventListener("pointerdown", (event) => this.take(event), true);
    canvas.addEventListener("pointermove", (event) => this.drag(event), true);
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => this.release(event), true);
    }
  }

  // First what is right there, the object's knob before all; then bodies, a little larger than they
  // are seen; then what is near.
  under(x, y, pointer) {
    const { points, meshes } = this.handles(), [tight, wide] = NEAR[pointer] ?? NEAR.mouse;
    const away = points.map((one) => {
      const [px, py] = this.stage.pixel(one.at);
      return { one, away: Math.hypot(px - x, py - y) };
    });
    const nearest = (reach) => {
      const found = away.filter((each) => each.away < reach(each.one));
      found.sort((a, b) => a.away - b.away);
      return found[0] && { name: found[0].one.name, at: found[0].one.at.clone() };
    };
    return nearest((one) => (one.wide ? one.wide : 0)) ?? nearest(() => tight)
      ?? this.body(x, y, meshes) ?? nearest(() => wide) ?? null;
  }

  body(x, y, meshes) {
    const all = meshes.map((one) => one.mesh);
    for (const [dx, dy] of AROUND) {
      const hit = this.stage.ray(x + dx, y + dy).intersectObjects(all, true)[0];
      if (!hit) continue;
      const owner = meshes.find((one) => one.mesh === hit.object || one.mesh === hit.object.parent);
      return { name: owner.name, at: hit.point.clone() };
    }
    return undefined;
  }

  take(event) {
    if (event.button !== 0 || this.held) return;
    const found = this.under(event.clientX, event.clientY, event.pointerType);
    if (!found) return;
    const facing = this.stage.camera.getWorldDirection(new THREE.Vector3());
    this.plane = new THREE.Plane().setFromNormalAndCoplanarPoint(facing, found.at);
    this.held = { ...found, pointer: event.pointerId, x: event.clientX, y: event.clientY };
    // What is grabbed stays under the pointer, wherever on it that is.
    this.held.last = this.at(event) ?? found.at.clone();
    this.stage.controls.enabled = false;
    this.stage.canvas.setPointerCapture(event.pointerId);
    this.stage.canvas.classList.add("held");
    event.stopImmediatePropagation();
  }

  at(event) {
    return this.stage.ray(event.clientX, event.clientY).ray.intersectPlane(this.plane, new THREE.Vector3());
  }

  drag(event) {
    if (!this.held) {
      const over = event.pointerType !== "touch" && this.under(event.clientX, event.clientY, "mouse");
      this.stage.canvas.classList.toggle("over", Boolean(over));
      return;
    }
    if (event.pointerId !== this.held.pointer) return;
    event.stopImmediatePropagation();
    const to = this.at(event);
    if (!to) return;
    const screen = { x: event.clientX - this.held.x, shift: event.shiftKey };
    this.move(this.held.name, to.clone().sub(this.held.last), screen);
    Object.assign(this.held, { last: to, x: event.clientX, y: event.clientY });
  }

  release(event) {
    if (!this.held || event.pointerId !== this.held.pointer) return;
    event.stopImmediatePropagation();
    const { name } = this.held;
    this.held = null;
    this.stage.controls.enabled = true;
    this.stage.canvas.classList.remove("held");
    this.move(name, null, null);
  }
}
