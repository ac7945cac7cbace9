// The camera of the page and its limits.
"use strict";
const $ = (id) => document.getElementById(id);
const facts = JSON.parse($("facts").textContent), offer = facts.offer;

// ---- vectors; matrices are stored by rows, world to camera ----
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.hypot(...a);
const unit = (a) => times(a, 1 / norm(a));
const rotated = (v, axis, angle) => {
  const c = Math.cos(angle), s = Math.sin(angle);
  return plus(plus(times(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
};
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// A camera has the unit vectors right, down and ahead, the centre `eye`, and intrinsics in px of an image of w x h.
function cameraOf(i) {
  const c = facts.cameras[i], [right, down, ahead] = [c.R.slice(0, 3), c.R.slice(3, 6), c.R.slice(6, 9)];
  const eye = times(plus(plus(times(right, c.t[0]), down, c.t[1]), ahead, c.t[2]), -1);
  return { right, down, ahead, eye, w: c.w, h: c.h, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy };
}

const { center, radius, arc, isObject, isPhotographed } = facts.subject;
const eyes = facts.cameras.map((_, i) => cameraOf(i).eye);
const farthest = Math.max(...eyes.map((eye) => norm(plus(eye, center, -1))));
const limits = isObject
  ? { nearest: 0.15 * radius, farthest: Math.max(1.6 * farthest, 4 * radius), sideways: Math.max(2 * radius, 0.5 * farthest) }
  : { nearest: 0.02 * facts.unit, farthest: 6 * facts.unit + farthest, sideways: 3 * facts.unit + farthest };
let camera, target; // the camera turns about the target
let shown = 0, atPhotograph = false; // last photograph visited; whether the camera is still there
let limited = true, spinning = 0; // spinning: radians per second

function isInImage(c, point) {
  const p = plus(point, c.eye, -1), z = dot(p, c.ahead);
  const [x, y] = [(c.fx * dot(p, c.right)) / z + c.cx, (c.fy * dot(p, c.down)) / z + c.cy];
  return z > facts.near && x > 0 && x < c.w && y > 0 && y < c.h;
}

function goTo(i) {
  shown = (i + facts.cameras.length) % facts.cameras.length;
  camera = cameraOf(shown);
  const depth = Math.max(dot(plus(center, camera.eye, -1), camera.ahead), 0.1 * facts.unit);
  target = isObject && isInImage(camera, center) ? center : plus(camera.eye, camera.ahead, depth);
  arrive(facts.cameras[shown].name, true);
}

function goHome() {
  // At the camera of a photograph; an object is centred and fills the window.
  goTo(facts.subject.home);
  if (isObject) {
    const arm = plus(center, camera.eye, -1), distance = norm(arm), longer = Math.max(camera.w, camera.h);
    if (Math.abs(dot(unit(arm), facts.up)) < 0.99) {
      camera.ahead = unit(arm);
      camera.right = unit(cross(camera.ahead, facts.up));
      camera.down = cross(camera.ahead, camera.right);
    }
    const needed = 2.2 * camera.fx * Math.tan(Math.asin(Math.min(0.95, radius / distance)));
    const side = clamp(needed, 0.4 * longer, longer); // not wider than the photograph: little was trained there
    [camera.w, camera.h, camera.cx, camera.cy] = [side, side, side / 2, side / 2];
    target = center;
  }
  arrive("Opening view", false);
}

function arrive(name, isPhotograph) {
  setSpinning(false);
  atPhotograph = isPhotograph;
  $("view").textContent = name;
  moved();
}

function leave() {
  // The visitor moves the camera.
  if (atPhotograph) $("view").textContent = "Free view";
  atPhotograph = false;
  moved();
}

// ---- photographed directions: all around the subject, or an arc ----
function direction(arm) {
  const north = arc.middle, east = cross(facts.up, north);
  const [n, e] = [dot(arm, north), dot(arm, east)];
  return { azimuth: Math.atan2(e, n), elevation: Math.atan2(dot(arm, facts.up), Math.hypot(n, e)) };
}
const excess = (x, low, high) => Math.max(low - x, x - high, 0);
const outside = ({ azimuth, elevation }) => [excess(Math.abs(azimuth), 0, arc.half), excess(elevation, arc.low, arc.high)];

function rotateCamera(axis, angle) {
  camera.eye = plus(target, rotated(plus(camera.eye, target, -1), axis, angle));
  for (const name of ["right", "down", "ahead"]) camera[name] = unit(rotated(camera[name], axis, angle));
}

function orbit(dx, dy) {
  // Each rotation only if it does not lead further out of the photographed directions.
  const rotate = (axis, angle) => {
    const arm = plus(camera.eye, target, -1), before = outside(direction(arm)), after = outside(direction(rotated(arm, axis, angle)));
    const isAllowed = !limited || after.every((angle, i) => angle <= Math.max(before[i], 1e-9));
    if (isAllowed) rotateCamera(axis, angle);
    return isAllowed;
  };
  const isTurned = dx === 0 || rotate(facts.up, dot(facts.up, camera.down) > 0 ? dx : -dx);
  const steepness = (ahead) => Math.abs(dot(ahead, facts.up)), next = rotated(camera.ahead, camera.right, -dy);
  if (dy && (steepness(next) < 0.995 || steepness(next) < steepness(camera.ahead))) rotate(camera.right, -dy); // not over the pole
  leave();
  return isTurned;
}

function pan(dx, dy) {
  const px = norm(plus(target, camera.eye, -1)) / camera.fx / fit();
  const motion = plus(times(camera.right, -dx * px), camera.down, -dy * px), next = plus(target, motion);
  const distance = (point) => norm(plus(point, center, -1));
  if (limited && distance(next) > limits.sideways && distance(next) > distance(target)) return;
  [camera.eye, target] = [plus(camera.eye, motion), next];
  leave();
}

function zoom(factor) {
  const arm = plus(camera.eye, target, -1), length = norm(arm), wanted = length * factor;
  const next = limited ? clamp(wanted, Math.min(limits.nearest, length), Math.max(limits.farthest, length)) : wanted;
  camera.eye = plus(target, arm, next / length);
  leave();
}

function isUnseen() {
  // Whether no photograph was taken from near the camera.
  if (atPhotograph || !isPhotographed) return false;
  if (!isObject) return Math.min(...eyes.map((eye) => norm(plus(eye, camera.eye, -1)))) > 0.75 * facts.unit;
  const arm = plus(camera.eye, center, -1), distance = norm(arm);
  const angles = eyes.map((eye) => {
    const other = plus(eye, center, -1);
    return Math.acos(clamp(dot(other, arm) / Math.max(norm(other) * distance, 1e-12), -1, 1));
  });
  return distance > radius && Math.min(...angles) > 0.5;
}
