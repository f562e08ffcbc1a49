// Meshes of the robot, of solids and of contacts.
import * as THREE from "three";

/* global PALETTE */
// Geometries by the solver's names of kinds; axes of revolution are z.
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
const ALONG = new THREE.Vector3(0, 0, 1);
const PAD = [0.0056, 0.003]; // radius and thickness [m]

// Colours of fingers, for two hands.
export const COLORS = [
  "#f0a400", "#2f7fd6", "#16a39a", "#b04fc9", "#e0528a", "#8fae1b", "#7a5a3c", "#5b4fcf", "#d8492a", "#6f8796",
];

const solid = (color) => new THREE.MeshStandardMaterial({ color, roughness: 0.7, metalness: 0 });

function meshOf(shape, size, material) {
  const mesh = new THREE.Mesh(GEOMETRY[shape](size), material);
  mesh.castShadow = true;
  mesh.receiveShadow = true;
  return mesh;
}

// Returns the matrix of a pose: the rotation by rows, then the origin.
export function matrixOf(pose) {
  const [a, b, c, d, e, f, g, h, i, x, y, z] = pose;
  return new THREE.Matrix4().set(a, b, c, x, d, e, f, y, g, h, i, z, 0, 0, 0, 1);
}

export function poseOf(matrix) {
  const m = matrix.elements;
  return [m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10], m[12], m[13], m[14]];
}

// Collision shapes of a robot, with a pad at each fingertip.
export class RobotBody extends THREE.Group {
  constructor({ about, shapes, fingers }) {
    super();
    const shown = shapes.capsules.map((one, i) => ({ ...one, at: 6 * i, kind: "capsule" })).filter((one) => one.shown);
    const first = 6 * shapes.capsules.length;
    const solids = shapes.solids.map((one, i) => ({ ...one, at: first + 12 * i }));
    const pads = fingers.map((_, i) => ({ kind: "pad", at: 3 * i, link: "" }));
    this.parts = [...shown, ...solids, ...pads].map((one) => {
      const [role, color] = about.looks[one.link] ?? ["pad", PALETTE.pad], usual = solid(color);
      const mesh = new THREE.Mesh(undefined, usual);
      mesh.castShadow = mesh.receiveShadow = true;
      this.add(mesh);
      return { ...one, role, usual, mesh };
    });
    this.touching = solid(PALETTE.touching);
  }

  // Moves the shapes and pads to the configuration q.
  place(q, solver) {
    const places = solver.shapes(q), { points, normals } = solver.contacts(q);
    const way = new THREE.Vector3();
    const turn = (mesh, size) => {
      if (!mesh.geometry.parameters) mesh.geometry = size();
      if (way.lengthSq() > 1e-18) mesh.quaternion.setFromUnitVectors(ALONG, way.normalize());
    };
    for (const { mesh, kind, at, size, radius } of this.parts) {
      if (kind === "capsule") {
        mesh.position.fromArray(places, at);
        way.fromArray(places, at + 3);
        turn(mesh, () => GEOMETRY.CAPSULE([radius, 2 * way.length()]));
      } else if (kind === "pad") {
        mesh.position.fromArray(points, at);
        way.fromArray(normals, at);
        turn(mesh, () => GEOMETRY.CYLINDER(PAD));
      } else {
        if (!mesh.geometry.parameters) mesh.geometry = GEOMETRY[kind.toUpperCase()](size);
        matrixOf(places.subarray(at, at + 12)).decompose(mesh.position, mesh.quaternion, mesh.scale);
      }
    }
  }

  // Highlights colliding links.
  mark(links) {
    for (const part of this.parts) {
      part.mesh.material = links.includes(part.link) ? this.touching : part.usual;
    }
  }

  // Returns the corners of the bounding boxes of all shapes, or of the hand's.
  corners(handOnly) {
    const found = [], box = new THREE.Box3();
    for (const { mesh, role } of this.parts) {
      if (handOnly && role === "arm") continue;
      mesh.updateMatrixWorld();
      mesh.geometry.boundingBox ?? mesh.geometry.computeBoundingBox();
      box.copy(mesh.geometry.boundingBox);
      for (const x of [box.min.x, box.max.x]) for (const y of [box.min.y, box.max.y]) {
        for (const z of [box.min.z, box.max.z]) found.push(new THREE.Vector3(x, y, z).applyMatrix4(mesh.matrixWorld));
      }
    }
    return found;
  }
}

export class SolidGroup extends THREE.Group {
  // Solids of the object (translucent) or of the obstacle.
  constructor(solids, isObject) {
    super();
    this.material = solid(isObject ? PALETTE.object : PALETTE.scene);
    if (isObject) Object.assign(this.material, { transparent: true, opacity: 0.6, depthWrite: false });
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

// Handle of the object: a disc at its centre, drawn over everything.
export class Knob extends THREE.Group {
  constructor() {
    super();
    const seen = { depthTest: false, transparent: true, toneMapped: false };
    const disc = (radius, color) =>
      new THREE.Mesh(new THREE.CircleGeometry(radius, 40), new THREE.MeshBasicMaterial({ ...seen, color }));
    const bar = (turn) => {
      const mesh = new THREE.Mesh(
        new THREE.PlaneGeometry(1.2, 0.24), new THREE.MeshBasicMaterial({ ...seen, color: "#ffffff" }),
      );
      mesh.rotation.z = turn;
      return mesh;
    };
    [disc(1.22, "#ffffff"), disc(1, "#1b6ea8"), bar(0), bar(UPRIGHT)].forEach((mesh, i) => {
      mesh.renderOrder = 20 + i;
      this.add(mesh);
    });
  }

  place(at, size, camera) {
    this.position.copy(at);
    this.scale.setScalar(size);
    this.quaternion.copy(camera.quaternion);
  }
}

// A contact: a ball at the point, an arrow along the normal, a line to the fingertip. Drawn over
// everything.
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
