// The head's pose as Live Link Face and three.js have it, of the graph's rotation from the rig to an OpenCV camera.

/** The same rotation in a world of y up and z to the viewer: nine numbers, row by row; none where it is not known. */
export function upright(rotation) {
  return Array.from(rotation, (value, i) => (i < 3 ? value : -value));
}

/** Yaw, pitch and roll, radians: positive to the viewer's right, down, and counter-clockwise. */
export function headAngles(rotation) {
  const r = upright(rotation);
  if (!r.every(Number.isFinite)) return [0, 0, 0];
  return [Math.atan2(r[2], r[8]), Math.asin(Math.min(1, Math.max(-1, -r[5]))), Math.atan2(r[3], r[4])];
}

/** The rotation from the rig to an OpenCV camera of these angles; the inverse of `headAngles`. */
export function headRotation([yaw, pitch, roll]) {
  const [sy, sx, sz] = [yaw, pitch, roll].map(Math.sin), [cy, cx, cz] = [yaw, pitch, roll].map(Math.cos);
  return Float32Array.from(upright([
    cy * cz + sy * sx * sz, sy * sx * cz - cy * sz, sy * cx,
    cx * sz, cx * cz, -sx,
    cy * sx * sz - sy * cz, cy * sx * cz + sy * sz, cy * cx,
  ]));
}
