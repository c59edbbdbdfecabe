// A camera that orbits a pivot. Its axes are those of a transforms.json: x right, y up, looking along -z.

const NEAREST_POLE = 0.02; // smallest angle between the line of sight and the vertical, in radians
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, times = 1) => a.map((value, i) => value + times * b[i]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));

class Camera {
  // view: {pose (4 x 4), focal: relative to half the shorter edge, distance: of the pivot}; up: the vertical; radius:
  // of the scene.
  constructor(view, up, radius) {
    this.up = up;
    this.radius = radius;
    this.set(view);
  }

  set({ pose, focal, distance }) {
    this.rotation = [0, 1, 2].map((column) => unit([0, 1, 2].map((row) => pose[row][column])));
    this.position = [0, 1, 2].map((row) => pose[row][3]);
    this.focal = focal;
    this.distance = distance;
  }

  get pivot() {
    return plus(this.position, this.rotation[2], -this.distance);
  }

  get pose() {
    const [right, up, back] = this.rotation, at = this.position;
    return [0, 1, 2].map((row) => [right[row], up[row], back[row], at[row]]).concat([[0, 0, 0, 1]]);
  }

  // Orbit around the vertical by `across`, then towards the pole by `along`, in radians.
  orbit(across, along) {
    const pivot = this.pivot, height = Math.asin(Math.max(-1, Math.min(1, dot(this.rotation[2], this.up))));
    const most = Math.PI / 2 - NEAREST_POLE, pitch = Math.max(-most - height, Math.min(most - height, along));
    this.rotation = this.rotation.map((axis) => turned(axis, this.up, across));
    // Pitch around the horizontal axis that is perpendicular to the line of sight, so that a rolled camera keeps its
    // roll.
    const level = cross(this.up, this.rotation[2]), around = Math.hypot(...level) > 1e-9 ? unit(level) : this.rotation[0];
    this.rotation = this.rotation.map((axis) => unit(turned(axis, around, -pitch)));
    this.position = plus(pivot, this.rotation[2], this.distance);
  }

  // Pan by x and y pixels of a picture whose shorter edge has `edge` pixels.
  pan(x, y, edge) {
    const reach = (2 * this.distance) / (this.focal * edge);
    this.position = plus(plus(this.position, this.rotation[0], -x * reach), this.rotation[1], y * reach);
  }

  zoom(times) {
    const pivot = this.pivot;
    this.distance = Math.max(0.01 * this.radius, Math.min(100 * this.radius, this.distance * times));
    this.position = plus(pivot, this.rotation[2], this.distance);
  }

  // Look at another point from the same direction and distance.
  centre(pivot) {
    this.position = plus(pivot, this.rotation[2], this.distance);
  }

  // The view in the page's address: position, right, up, distance, focal. The setter ignores text that is not a valid
  // view.
  get hash() {
    const numbers = [...this.position, ...this.rotation[0], ...this.rotation[1], this.distance, this.focal];
    return "#view=" + numbers.map((value) => Number(value.toPrecision(9))).join(",");
  }

  set hash(text) {
    const numbers = (/^#view=(.*)$/.exec(text)?.[1] ?? "").split(",").map(Number);
    if (numbers.length !== 11 || !numbers.every(Number.isFinite) || !(numbers[9] > 0) || !(numbers[10] > 0)) return;
    const right = numbers.slice(3, 6), up = numbers.slice(6, 9), back = cross(right, up);
    if (Math.abs(Math.hypot(...back) - 1) > 1e-3 || Math.abs(dot(right, up)) > 1e-3) return;
    this.position = numbers.slice(0, 3);
    this.rotation = [unit(right), unit(cross(back, right)), unit(back)];
    [this.distance, this.focal] = numbers.slice(9);
  }

  // The content of a transforms.json with this view as its only frame. lens: focal length, relative to half the shorter
  // edge.
  capture(width, height, lens) {
    const focal = (lens * Math.min(width, height)) / 2;
    return {
      fl_x: focal, fl_y: focal, cx: width / 2, cy: height / 2, w: width, h: height,
      frames: [{ file_path: "view", transform_matrix: this.pose }],
    };
  }
}

// Rotate a vector around a unit axis.
function turned(a, axis, angle) {
  const sine = Math.sin(angle), cosine = Math.cos(angle), along = dot(axis, a) * (1 - cosine), side = cross(axis, a);
  return a.map((value, i) => value * cosine + side[i] * sine + axis[i] * along);
}
