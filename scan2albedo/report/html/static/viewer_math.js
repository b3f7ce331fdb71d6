// Vectors and 4 x 4 matrices, column by column as WebGL takes them.
const RADIANS = Math.PI / 180;
const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus3 = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const along3 = (a, direction, length) => a.map((value, i) => value + length * direction[i]);
const cross3 = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit3 = (a) => { const length = Math.hypot(...a) || 1; return a.map((value) => value / length); };
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

// From +z toward +x, and from the xz-plane toward +y, as PointLight has it.
function directionOf(azimuth, elevation) {
  const a = azimuth * RADIANS, e = elevation * RADIANS;
  return [Math.cos(e) * Math.sin(a), Math.sin(e), Math.cos(e) * Math.cos(a)];
}

function product4(a, b) {
  const result = new Float32Array(16);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + row] * b[4 * column + k];
      result[4 * column + row] = sum;
    }
  }
  return result;
}

function lookAt(eye, target) {
  const back = unit3(minus3(eye, target));
  const helper = Math.abs(back[1]) < 0.999 ? [0, 1, 0] : [0, 0, -1];
  const right = unit3(cross3(helper, back)), up = cross3(back, right);
  return [
    right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
    -dot3(right, eye), -dot3(up, eye), -dot3(back, eye), 1,
  ];
}

// Scales are 2 focal / width and 2 focal / height.
function perspective(scaleX, scaleY, near, far) {
  return [scaleX, 0, 0, 0, 0, scaleY, 0, 0, 0, 0, (near + far) / (near - far), -1, 0, 0, 2 * near * far / (near - far), 0];
}

function orthographic(radius, near, far) {
  return [1 / radius, 0, 0, 0, 0, 1 / radius, 0, 0, 0, 0, 2 / (near - far), 0, 0, 0, (near + far) / (near - far), 1];
}
