// Dragging with the pointer: hit tests and moves.
import * as THREE from "three";

// Radii of hit tests [pixels]: over other items, and where there is no other item.
const HIT_RADII = { mouse: [8, 16], pen: [10, 20], touch: [14, 30] };
const BODY_OFFSETS = [[0, 0], [9, 0], [-9, 0], [0, 9], [0, -9]];

// Handles pointer events. `handles` returns draggable points, { at, name, wide }, and meshes,
// { mesh, name }; `move` receives the name, the displacement [m] and the motion on the screen.
export class DragController {
  constructor(viewport, handles, move) {
    Object.assign(this, { viewport, handles, move });
    this.dragged = null;
    const canvas = viewport.canvas;
    // Captures events before the listeners of the camera.
    canvas.addEventListener("pointerdown", (event) => this.start(event), true);
    canvas.addEventListener("pointermove", (event) => this.drag(event), true);
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => this.release(event), true);
    }
  }

  // Returns the item under the pointer: the object's knob, points within the small radius, bodies with
  // a margin, points within the large radius.
  hitTest(x, y, pointer) {
    const { points, meshes } = this.handles(), [tight, wide] = HIT_RADII[pointer] ?? HIT_RADII.mouse;
    const away = points.map((one) => {
      const [px, py] = this.viewport.pixel(one.at);
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
    for (const [dx, dy] of BODY_OFFSETS) {
      const hit = this.viewport.ray(x + dx, y + dy).intersectObjects(all, true)[0];
      if (!hit) continue;
      const owner = meshes.find((one) => one.mesh === hit.object || one.mesh === hit.object.parent);
      return { name: owner.name, at: hit.point.clone() };
    }
    return undefined;
  }

  start(event) {
    if (event.button !== 0 || this.dragged) return;
    const found = this.hitTest(event.clientX, event.clientY, event.pointerType);
    if (!found) return;
    const facing = this.viewport.camera.getWorldDirection(new THREE.Vector3());
    this.plane = new THREE.Plane().setFromNormalAndCoplanarPoint(facing, found.at);
    this.dragged = { ...found, pointer: event.pointerId, x: event.clientX, y: event.clientY };
    // The grabbed point stays under the pointer.
    this.dragged.last = this.at(event) ?? found.at.clone();
    this.viewport.controls.enabled = false;
    this.viewport.canvas.setPointerCapture(event.pointerId);
    this.viewport.canvas.classList.add("held");
    event.stopImmediatePropagation();
  }

  at(event) {
    return this.viewport.ray(event.clientX, event.clientY).ray.intersectPlane(this.plane, new THREE.Vector3());
  }

  drag(event) {
    if (!this.dragged) {
      const over = event.pointerType !== "touch" && this.hitTest(event.clientX, event.clientY, "mouse");
      this.viewport.canvas.classList.toggle("over", Boolean(over));
      return;
    }
    if (event.pointerId !== this.dragged.pointer) return;
    event.stopImmediatePropagation();
    const to = this.at(event);
    if (!to) return;
    const screen = { x: event.clientX - this.dragged.x, shift: event.shiftKey };
    this.move(this.dragged.name, to.clone().sub(this.dragged.last), screen);
    Object.assign(this.dragged, { last: to, x: event.clientX, y: event.clientY });
  }

  release(event) {
    if (!this.dragged || event.pointerId !== this.dragged.pointer) return;
    event.stopImmediatePropagation();
    const { name } = this.dragged;
    this.dragged = null;
    this.viewport.controls.enabled = true;
    this.viewport.canvas.classList.remove("held");
    this.move(name, null, null);
  }
}
