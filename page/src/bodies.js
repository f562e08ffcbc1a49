// What is drawn: the robot's shapes, solids, contacts.
import * as THREE from "three";

/* global PALETTE */
// By the solver's names of kinds: what a solid looks like, along z where it is along anything.
const UPRIGHT = Math.PI / 2;
const GEOMETRY = {
  BOX: (size) => new THREE.BoxGeometry(...size),
  CAPSULE: ([radius, length]) =>
    length > 0
      ? new THREE.CapsuleGeometry(radius, length, 12, 32).rotateX(UPRIGHT)
      : new THREE.SphereGeometry(radius, 40, 28),
  CYLINDER: ([radius, length]) =>
    new THREE.CylinderGeometry(radius, radius, length, 48).rotateX(UPRIGHT),
};
const UP = new THREE.Vector3(0, 1, 0);

export const COLORS = ["#f0a400", "#2f7fd6", "#16a39a", "#b04fc9", "#e0528a"];

const solid = (color) => new THREE.MeshStandardMaterial({ color, roughness: 0.7, metalness: 0 });

function meshOf(shape, size, material) {
  const mesh = new THREE.Mesh(GEOMETRY[shape](size), material);
  mesh.castShadow = true;
  mesh.receiveShadow = true;
  return mesh;
}

// A pose as the solver has it: rotation row by row, then the origin.
export function matrixOf(pose) {
  const [a, b, c, d, e, f, g, h, i, x, y, z] = pose;
  return new THREE.Matrix4().set(a, b, c, x, d, e, f, y, g, h, i, z, 0, 0, 0, 1);
}

export function poseOf(matrix) {
  const m = matrix.elements;
  return [m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10], m[12], m[13], m[14]];
}

export class RobotBody extends THREE.Group {
  constructor(shapes, armLinks, places) {
    super();
    const arm = new Set(armLinks);
    this.parts = [];
    const materials = {
      arm: solid(PALETTE.arm), hand: solid(PALETTE.hand), touching: solid(PALETTE.touching),
    };
    this.materials = materials;
    const put = (mesh, link, at, isSolid) => {
      const usual = arm.has(link) ? materials.arm : materials.hand;
      mesh.material = usual;
      this.parts.push({ mesh, link, at, isSolid, usual });
      this.add(mesh);
    };
    shapes.capsules.forEach((capsule, i) => {
      if (!capsule.shown) return;
      const half = Math.hypot(...places.slice(6 * i + 3, 6 * i + 6));
      put(meshOf("CAPSULE", [capsule.radius, 2 * half], null), capsule.link, 6 * i, false);
    });
    const first = 6 * shapes.capsules.length;
    shapes.solids.forEach((one, i) => {
      put(meshOf(one.kind.toUpperCase(), one.size, null), one.link, first + 12 * i, true);
    });
    this.place(places);
  }

  place(places) {
    const way = new THREE.Vector3();
    const along = new THREE.Vector3(0, 0, 1);
    for (const { mesh, at, isSolid } of this.parts) {
      if (isSolid) {
        matrixOf(places.subarray(at, at + 12)).decompose(mesh.position, mesh.quaternion, mesh.scale);
      } else {
        mesh.position.set(places[at], places[at + 1], places[at + 2]);
        way.set(places[at + 3], places[at + 4], places[at + 5]);
        if (way.lengthSq() > 1e-18) mesh.quaternion.setFromUnitVectors(along, way.normalize());
      }
    }
  }

  // Links that touch something are red.
  mark(links) {
    for (const part of this.parts) {
      part.mesh.material = links.includes(part.link) ? this.materials.touching : part.usual;
    }
  }
}

export class Things extends THREE.Group {
  // Solids in one: the object (seen through) or the obstacle.
  constructor(solids, isObject) {
    super();
    this.material = solid(isObject ? PALETTE.object : PALETTE.scene);
    if (isObject) Object.assign(this.material, { transparent: true, opacity: 0.55, depthWrite: false });
    this.solids = solids;
    for (const one of solids) {
      const mesh = meshOf(one.shape, one.size, this.material);
      matrixOf(one.pose).decompose(mesh.position, mesh.quaternion, mesh.scale);
      this.add(mesh);
    }
  }

  place() {
    this.solids.forEach((one, i) => {
      const mesh = this.children[i];
      matrixOf(one.pose).decompose(mesh.position, mesh.quaternion, mesh.scale);
    });
  }
}

// A contact: a ball where the fingertip must be, an arrow the way it must face, a line from where
// the fingertip is. Seen through everything.
export class ContactMark extends THREE.Group {
  constructor(color) {
    super();
    const seen = { color, depthTest: false, transparent: true, toneMapped: false };
    const material = new THREE.MeshBasicMaterial(seen);
    this.ball = new THREE.Mesh(new THREE.SphereGeometry(1, 24, 16), material);
    this.rim = new THREE.Mesh(
      new THREE.SphereGeometry(1.22, 24, 16),
      new THREE.MeshBasicMaterial({ ...seen, color: 0xffffff }),
    );
    this.shaft = new THREE.Mesh(new THREE.CylinderGeometry(1, 1, 1, 12).translate(0, 0.5, 0), material);
    this.tip = new THREE.Mesh(new THREE.ConeGeometry(1, 2, 20), material);
    this.miss = new THREE.Line(
      new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(6, 3)),
      new THREE.LineBasicMaterial({ color: 0xd62f3c, depthTest: false, transparent: true }),
    );
    this.miss.frustumCulled = false;
    [this.miss, this.shaft, this.tip, this.rim, this.ball].forEach((mesh, i) => {
      mesh.renderOrder = 10 + i;
      this.add(mesh);
    });
  }

  // `size` [m]: the radius of the ball.
  place(point, normal, tip, size, held) {
    this.length = 7 * size;
    this.shaft.visible = this.tip.visible = Boolean(normal);
    if (normal) this.turn(point, normal, size);
    const big = held ? 1.3 * size : size;
    this.ball.position.copy(point);
    this.rim.position.copy(point);
    this.ball.scale.setScalar(big);
    this.rim.scale.setScalar(big);
    const line = this.miss.geometry.attributes.position;
    line.setXYZ(0, ...point.toArray());
    line.setXYZ(1, ...tip.toArray());
    line.needsUpdate = true;
  }

  turn(point, normal, size) {
    this.end = point.clone().addScaledVector(normal, this.length);
    this.shaft.position.copy(point);
    this.shaft.scale.set(0.22 * size, this.length, 0.22 * size);
    this.shaft.quaternion.setFromUnitVectors(UP, normal);
    this.tip.position.copy(this.end);
    this.tip.scale.setScalar(0.75 * size);
    this.tip.quaternion.copy(this.shaft.quaternion);
  }
}
