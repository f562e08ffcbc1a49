// Camera, light, floor: what everything else stands in. Drawn when something has changed.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const FLOOR = { light: [0xaab4be, 0xd3dae1, 0.18], dark: [0x4b5a69, 0x28323c, 0.4] };
const AROUND = 1.2; // of what has to be seen, left free about it
const INSET = { part: 0.3, most: 230, edge: 12 }; // of the width; [pixels]

const TIP = 0.02; // how far what touches a point may be from it [m]

// To where a picture is taken from: by azimuth and elevation [rad].
function outOf([azimuth, elevation]) {
  const flat = Math.cos(elevation);
  return new THREE.Vector3(flat * Math.cos(azimuth), flat * Math.sin(azimuth), Math.sin(elevation));
}

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.PCFShadowMap;
    this.renderer.autoClear = false;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.02, 30);
    this.far = new THREE.PerspectiveCamera(32, 1, 0.02, 30);
    this.camera.up.set(0, 0, 1);
    this.far.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0xb9c2ca, 2.3));
    this.sun = new THREE.DirectionalLight(0xffffff, 1.7);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    this.sun.shadow.bias = -0.0008;
    this.sun.shadow.normalBias = 0.01;
    this.scene.add(this.sun, this.sun.target);
    this.floor = new THREE.Mesh(new THREE.PlaneGeometry(8, 8), new THREE.ShadowMaterial());
    this.floor.receiveShadow = true;
    this.scene.add(this.floor);
    this.frames = [];
    new ResizeObserver(() => this.fit()).observe(canvas.parentElement);
    this.fit();
  }

  paint(dark) {
    const [lines, faint, shade] = FLOOR[dark ? "dark" : "light"];
    this.grid?.removeFromParent();
    this.grid?.dispose();
    this.grid = new THREE.GridHelper(4, 40, lines, faint);
    this.grid.rotation.x = Math.PI / 2;
    this.grid.position.z = this.floor.position.z;
    this.floor.material.opacity = shade;
    this.scene.add(this.grid);
    this.draw();
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    const side = Math.round(Math.min(INSET.part * width, 0.42 * height, INSET.most));
    this.inset = { side, x: INSET.edge, y: height - side - INSET.edge };
    this.canvas.parentElement.style.setProperty("--inset", `${side}px`);
    this.draw();
  }

  // Puts a camera where it sees all points from a side, and nothing else fits.
  aim(camera, side, points) {
    const out = outOf(side), [azimuth] = side;
    const right = new THREE.Vector3(-Math.sin(azimuth), Math.cos(azimuth), 0);
    const up = out.clone().cross(right);
    const tall = Math.tan((camera.fov * Math.PI) / 360) / AROUND, wide = tall * camera.aspect;
    const center = new THREE.Box3().setFromPoints(points).getCenter(new THREE.Vector3());
    let away = 0;
    for (let round = 0; round < 4; ++round) {
      // As far as the sides of the picture allow; then the middle of what is seen, and again.
      const least = { x: Infinity, y: Infinity }, most = { x: -Infinity, y: -Infinity };
      away = 0;
      const seen = points.map((point) => point.clone().sub(center));
      for (const one of seen) {
        away = Math.max(away, one.dot(out) + Math.abs(one.dot(right)) / wide, one.dot(out) + Math.abs(one.dot(up)) / tall);
      }
      for (const one of seen) {
        const depth = away - one.dot(out), x = one.dot(right) / depth, y = one.dot(up) / depth;
        Object.assign(least, { x: Math.min(least.x, x), y: Math.min(least.y, y) });
        Object.assign(most, { x: Math.max(most.x, x), y: Math.max(most.y, y) });
      }
      if (round === 3) break;
      center.addScaledVector(right, (away * (least.x + most.x)) / 2);
      center.addScaledVector(up, (away * (least.y + most.y)) / 2);
    }
    camera.position.copy(center).addScaledVector(out, away);
    camera.lookAt(center);
    camera.updateMatrixWorld();
    return { center, away };
  }

  // The side near a preferred one from which most of some points are seen past bodies.
  side(preferred, points, bodies) {
    const caster = new THREE.Raycaster(), way = outOf(preferred);
    const seen = (out) =>
      points.filter((point) => {
        // Fingertips that touch a point do not hide it.
        caster.set(point.clone().addScaledVector(out, TIP), out);
        return !caster.intersectObjects(bodies, false).length;
      }).length;
    let best = preferred, most = -Infinity;
    for (let i = 0; i < 16; ++i) {
      for (const elevation of [0.15, 0.35, 0.6]) {
        const side = i ? [preferred[0] + (i * Math.PI) / 8, elevation] : preferred, out = outOf(side);
        const score = seen(out) / points.length + 0.1 * out.dot(way);
        if (score > most + 1e-9) [best, most] = [side, score];
      }
    }
    return best;
  }

  // Looks at points from a side.
  look(side, points) {
    const { center, away } = this.aim(this.camera, side, points);
    this.controls.target.copy(center);
    this.controls.minDistance = 0.1 * away;
    this.controls.maxDistance = 12 * away;
    this.controls.update();
    this.camera.updateMatrixWorld();
    this.draw();
  }

  // The picture in the corner, and the light of everything in it.
  lookWhole(side, points) {
    this.aim(this.far, side, points);
    const box = new THREE.Box3().setFromPoints(points), floor = Math.min(box.min.z, 0);
    const { center, radius } = box.getBoundingSphere(new THREE.Sphere());
    this.floor.position.z = floor;
    if (this.grid) this.grid.position.z = floor;
    this.sun.position.copy(center).add(new THREE.Vector3(0.6 * radius, -1.2 * radius, 2.6 * radius));
    this.sun.target.position.copy(center);
    const lit = this.sun.shadow.camera;
    lit.left = lit.bottom = -1.5 * radius;
    lit.right = lit.top = 1.5 * radius;
    lit.near = 0.1 * radius;
    lit.far = 6 * radius;
    lit.updateProjectionMatrix();
    this.draw();
  }

  // Calls are gathered: one picture a frame. `before` is done first, the last one asked for.
  draw(before) {
    if (before) this.before = before;
    if (this.asked) return;
    this.asked = requestAnimationFrame(() => {
      const begun = performance.now(), work = this.before;
      this.before = null;
      work?.();
      this.asked = 0;
      this.render();
      if (work) this.frames.push(performance.now() - begun);
      if (this.frames.length > 100) this.frames.shift();
    });
  }

  // The large picture; where it shows the hand, the whole robot in a corner of it.
  render() {
    const { renderer, scene, canvas } = this, { x, y, side } = this.inset;
    renderer.setScissorTest(false);
    renderer.setViewport(0, 0, canvas.clientWidth, canvas.clientHeight);
    renderer.clear();
    renderer.render(scene, this.camera);
    if (!this.near) return;
    renderer.shadowMap.autoUpdate = false;
    renderer.setViewport(x, y, side, side);
    renderer.setScissor(x, y, side, side);
    renderer.setScissorTest(true);
    renderer.clear();
    renderer.render(scene, this.far);
    renderer.shadowMap.autoUpdate = true;
  }

  // How many metres so many pixels are, where a point is.
  metres(pixels, point) {
    const away = this.camera.position.distanceTo(point);
    const whole = 2 * away * Math.tan((this.camera.fov * Math.PI) / 360);
    return (pixels * whole) / this.canvas.clientHeight;
  }

  // Where a point is seen [pixels of the page].
  pixel(point) {
    const seen = point.clone().project(this.camera), box = this.canvas.getBoundingClientRect();
    return [
      box.left + ((seen.x + 1) / 2) * box.width,
      box.top + ((1 - seen.y) / 2) * box.height,
    ];
  }

  // The ray through a place of the page.
  ray(x, y) {
    const box = this.canvas.getBoundingClientRect(), caster = new THREE.Raycaster();
    const at = new THREE.Vector2(
      (2 * (x - box.left)) / box.width - 1,
      1 - (2 * (y - box.top)) / box.height,
    );
    caster.setFromCamera(at, this.camera);
    return caster;
  }
}
