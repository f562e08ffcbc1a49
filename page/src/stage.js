// Camera, light, floor: what everything else stands in. Drawn when something has changed.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.PCFShadowMap;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.02, 30);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0xb9c2ca, 2.3));
    this.sun = new THREE.DirectionalLight(0xffffff, 1.7);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    this.sun.shadow.bias = -0.0008;
    this.sun.shadow.normalBias = 0.01;
    this.scene.add(this.sun, this.sun.target);
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    this.grid = new THREE.GridHelper(4, 40, dark ? 0x4b5a69 : 0xaab4be, dark ? 0x28323c : 0xd3dae1);
    this.grid.rotation.x = Math.PI / 2;
    const shadows = new THREE.ShadowMaterial({ opacity: dark ? 0.4 : 0.18 });
    this.floor = new THREE.Mesh(new THREE.PlaneGeometry(8, 8), shadows);
    this.floor.receiveShadow = true;
    this.scene.add(this.grid, this.floor);
    this.frames = [];
    new ResizeObserver(() => this.fit()).observe(canvas.parentElement);
    this.fit();
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  // Looks at a ball in which everything of interest is.
  look(center, radius, floor, goal) {
    // From ahead of the robot and a little to its side, so that the hand is before the arm.
    const ahead = Math.atan2(goal.y, goal.x) - 0.95;
    const way = new THREE.Vector3(Math.cos(ahead), Math.sin(ahead), 0.42).normalize();
    const narrow = Math.min(1, this.camera.aspect);
    const away = radius / Math.sin((this.camera.fov * Math.PI) / 360) / narrow;
    this.controls.target.copy(center);
    this.camera.position.copy(center).addScaledVector(way, away);
    this.controls.minDistance = 0.1 * away;
    this.controls.maxDistance = 4 * away;
    this.grid.position.z = this.floor.position.z = floor;
    this.sun.position.copy(center).add(new THREE.Vector3(0.6 * radius, -1.2 * radius, 2.6 * radius));
    this.sun.target.position.copy(center);
    const lit = this.sun.shadow.camera;
    lit.left = lit.bottom = -1.5 * radius;
    lit.right = lit.top = 1.5 * radius;
    lit.near = 0.1 * radius;
    lit.far = 6 * radius;
    lit.updateProjectionMatrix();
    this.controls.update();
    this.camera.updateMatrixWorld();
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
      this.renderer.render(this.scene, this.camera);
      if (work) this.frames.push(performance.now() - begun);
      if (this.frames.length > 100) this.frames.shift();
    });
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
