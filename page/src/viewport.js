// Cameras, lights and floor; rendered on demand.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const FLOOR = { light: [0xaab4be, 0xd3dae1, 0.18], dark: [0x4b5a69, 0x28323c, 0.4] };
const MARGIN = 1.2; // size of the view relative to its content
const INSET = { fraction: 0.3, maxSize: 230, edge: 12 }; // of the width; [pixels]

const TIP = 0.02; // distance within which a body does not occlude a contact [m]

// Returns the unit vector towards the camera for azimuth and elevation [rad].
function viewDirection([azimuth, elevation]) {
  const flat = Math.cos(elevation);
  return new THREE.Vector3(flat * Math.cos(azimuth), flat * Math.sin(azimuth), Math.sin(elevation));
}

export class Viewport {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.PCFShadowMap;
    this.renderer.autoClear = false;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.02, 30);
    this.insetCamera = new THREE.PerspectiveCamera(32, 1, 0.02, 30);
    this.camera.up.set(0, 0, 1);
    this.insetCamera.up.set(0, 0, 1);
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
    const side = Math.round(Math.min(INSET.fraction * width, 0.42 * height, INSET.maxSize));
    this.inset = { side, x: INSET.edge, y: height - side - INSET.edge };
    this.canvas.parentElement.style.setProperty("--inset", `${side}px`);
    this.draw();
  }

  // Moves a camera so that all points, seen from a side, fill its view.
  aim(camera, side, points) {
    const out = viewDirection(side), [azimuth] = side;
    const right = new THREE.Vector3(-Math.sin(azimuth), Math.cos(azimuth), 0);
    const up = out.clone().cross(right);
    const tall = Math.tan((camera.fov * Math.PI) / 360) / MARGIN, wide = tall * camera.aspect;
    const center = new THREE.Box3().setFromPoints(points).getCenter(new THREE.Vector3());
    let away = 0;
    for (let pass = 0; pass < 4; ++pass) {
      // Alternate between the smallest distance that shows all points and centring them.
      const minimum = { x: Infinity, y: Infinity }, maximum = { x: -Infinity, y: -Infinity };
      away = 0;
      const offsets = points.map((point) => point.clone().sub(center));
      for (const offset of offsets) {
        away = Math.max(away, offset.dot(out) + Math.abs(offset.dot(right)) / wide, offset.dot(out) + Math.abs(offset.dot(up)) / tall);
      }
      for (const offset of offsets) {
        const depth = away - offset.dot(out), x = offset.dot(right) / depth, y = offset.dot(up) / depth;
        Object.assign(minimum, { x: Math.min(minimum.x, x), y: Math.min(minimum.y, y) });
        Object.assign(maximum, { x: Math.max(maximum.x, x), y: Math.max(maximum.y, y) });
      }
      if (pass === 3) break;
      center.addScaledVector(right, (away * (minimum.x + maximum.x)) / 2);
      center.addScaledVector(up, (away * (minimum.y + maximum.y)) / 2);
    }
    camera.position.copy(center).addScaledVector(out, away);
    camera.lookAt(center);
    camera.updateMatrixWorld();
    return { center, away };
  }

  // Returns the view near a preferred one from which most points are not occluded by bodies.
  side(preferred, points, bodies) {
    const caster = new THREE.Raycaster(), way = viewDirection(preferred);
    const seen = (out) =>
      points.filter((point) => {
        // Fingertips that touch a point do not occlude it.
        caster.set(point.clone().addScaledVector(out, TIP), out);
        return !caster.intersectObjects(bodies, false).length;
      }).length;
    let best = preferred, maximum = -Infinity;
    for (let i = 0; i < 16; ++i) {
      for (const elevation of [0.15, 0.35, 0.6]) {
        const side = i ? [preferred[0] + (i * Math.PI) / 8, elevation] : preferred, out = viewDirection(side);
        const score = seen(out) / points.length + 0.1 * out.dot(way);
        if (score > maximum + 1e-9) [best, maximum] = [side, score];
      }
    }
    return best;
  }

  // Points the main camera at points from a side.
  look(side, points) {
    const { center, away } = this.aim(this.camera, side, points);
    this.controls.target.copy(center);
    this.controls.minDistance = 0.1 * away;
    this.controls.maxDistance = 12 * away;
    this.controls.update();
    this.camera.updateMatrixWorld();
    this.draw();
  }

  // Sets the camera of the inset, and fits floor and lights to the points.
  setInset(side, points) {
    this.aim(this.insetCamera, side, points);
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

  // Renders once per frame, after the latest `before`.
  draw(before) {
    if (before) this.before = before;
    if (this.framePending) return;
    this.framePending = requestAnimationFrame(() => {
      const start = performance.now(), work = this.before;
      this.before = null;
      work?.();
      this.framePending = 0;
      this.render();
      if (work) this.frames.push(performance.now() - start);
      if (this.frames.length > 100) this.frames.shift();
    });
  }

  // Renders the main view, and the whole robot as an inset while the main view shows the hand.
  render() {
    const { renderer, scene, canvas } = this, { x, y, side } = this.inset;
    renderer.setScissorTest(false);
    renderer.setViewport(0, 0, canvas.clientWidth, canvas.clientHeight);
    renderer.clear();
    renderer.render(scene, this.camera);
    if (!this.showsHand) return;
    renderer.shadowMap.autoUpdate = false;
    renderer.setViewport(x, y, side, side);
    renderer.setScissor(x, y, side, side);
    renderer.setScissorTest(true);
    renderer.clear();
    renderer.render(scene, this.insetCamera);
    renderer.shadowMap.autoUpdate = true;
  }

  // Returns the length [m] of a number of pixels at the depth of a point.
  metres(pixels, point) {
    const away = this.camera.position.distanceTo(point);
    const viewHeight = 2 * away * Math.tan((this.camera.fov * Math.PI) / 360);
    return (pixels * viewHeight) / this.canvas.clientHeight;
  }

  // Returns the position of a point on the page [pixels].
  pixel(point) {
    const seen = point.clone().project(this.camera), box = this.canvas.getBoundingClientRect();
    return [
      box.left + ((seen.x + 1) / 2) * box.width,
      box.top + ((1 - seen.y) / 2) * box.height,
    ];
  }

  // Returns the ray through a position on the page.
  ray(x, y) {
    const box = this.canvas.getBoundingClientRect(), caster = new THREE.Raycaster();
    const position = new THREE.Vector2(
      (2 * (x - box.left)) / box.width - 1,
      1 - (2 * (y - box.top)) / box.height,
    );
    caster.setFromCamera(position, this.camera);
    return caster;
  }
}
