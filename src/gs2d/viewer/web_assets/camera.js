// Where the visitor is, and how far the photographs let him go. No network, no libraries.
"use strict";
const $ = (id) => document.getElementById(id);
const facts = JSON.parse($("facts").textContent);

// ---- small vectors; matrices are rows, world to camera ----
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => times(a, 1 / Math.hypot(...a));
const turned = (v, axis, angle) => {
  const c = Math.cos(angle), s = Math.sin(angle);
  return plus(plus(times(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
};
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// right, down, ahead (unit, world), eye, and a lens in px of a picture of w x h; what is turned about is the target
const start = (i) => {
  const c = facts.cameras[i], [right, down, ahead] = [c.R.slice(0, 3), c.R.slice(3, 6), c.R.slice(6, 9)];
  const eye = times(plus(plus(times(right, c.t[0]), down, c.t[1]), ahead, c.t[2]), -1);
  return { right, down, ahead, eye, w: c.w, h: c.h, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy };
};
const { center, radius, arc } = facts.subject;
const eyes = facts.cameras.map((_, i) => start(i).eye);
const far = Math.max(...eyes.map((eye) => Math.hypot(...plus(eye, center, -1))));
const reach = facts.subject.object
  ? { least: 0.15 * radius, most: Math.max(1.6 * far, 4 * radius), aside: Math.max(2 * radius, 0.5 * far) }
  : { least: 0.02 * facts.unit, most: 6 * facts.unit + far, aside: 3 * facts.unit + far };
let shown = 0, here, target, kind = 0, limited = true, spinning = 0;

function inPicture(c, point) {
  const p = plus(point, c.eye, -1), z = dot(p, c.ahead);
  const [x, y] = [c.fx * dot(p, c.right) / z + c.cx, c.fy * dot(p, c.down) / z + c.cy];
  return z > facts.near && x > 0 && x < c.w && y > 0 && y < c.h;
}

function goTo(i) {
  shown = (i + facts.cameras.length) % facts.cameras.length;
  here = start(shown);
  const ahead = Math.max(dot(plus(center, here.eye, -1), here.ahead), 0.1 * facts.unit);
  target = facts.subject.object && inPicture(here, center) ? center : plus(here.eye, here.ahead, ahead);
  arrived(facts.cameras[shown].name);
}

function home() {
  // From where a photograph was taken, level, the subject in the middle and as large as the window lets it be.
  goTo(facts.subject.home);
  if (facts.subject.object) {
    const arm = plus(center, here.eye, -1), away = Math.hypot(...arm), short = Math.min(here.w, here.h);
    if (Math.abs(dot(unit(arm), facts.up)) < 0.99) {
      here.ahead = unit(arm);
      here.right = unit(cross(here.ahead, facts.up));
      here.down = cross(here.ahead, here.right);
    }
    const needed = 2.2 * here.fx * Math.tan(Math.asin(Math.min(0.95, radius / away)));
    const side = clamp(needed, 0.4 * short, short); // no wider than the photograph, whose rim nobody trained for
    [here.w, here.h, here.cx, here.cy] = [side, side, side / 2, side / 2];
    target = center;
  }
  arrived("opening view");
}

function arrived(name) {
  turnItself(false);
  told();
  $("view").textContent = name;
  touched();
}

// ---- what was photographed: directions from the subject, all round or an arc of them ----
function heading(arm) {
  const north = arc.middle, east = cross(facts.up, north), up = dot(arm, facts.up);
  const [n, e] = [dot(arm, north), dot(arm, east)];
  return { turn: Math.atan2(e, n), rise: Math.atan2(up, Math.hypot(n, e)) };
}
const beyond = (x, low, high) => Math.max(low - x, x - high, 0);
const outside = ({ turn, rise }) => [beyond(Math.abs(turn), 0, arc.half), beyond(rise, arc.low, arc.high)];

function swing(axis, angle) {
  here.eye = plus(target, turned(plus(here.eye, target, -1), axis, angle));
  for (const name of ["right", "down", "ahead"]) here[name] = unit(turned(here[name], axis, angle));
}

function orbit(dx, dy) {
  // Each part of the way only as far as it does not lead further out of what was photographed.
  const step = (axis, angle) => {
    const arm = plus(here.eye, target, -1), before = outside(heading(arm)), after = outside(heading(turned(arm, axis, angle)));
    const out = after.some((far, i) => far > Math.max(before[i], 1e-9));
    if (!(limited && out)) swing(axis, angle);
    return !(limited && out);
  };
  const went = dx === 0 || step(facts.up, dot(facts.up, here.down) > 0 ? dx : -dx);
  const steep = (ahead) => Math.abs(dot(ahead, facts.up)), next = turned(here.ahead, here.right, -dy);
  if (dy && (steep(next) < 0.995 || steep(next) < steep(here.ahead))) step(here.right, -dy); // beyond, all would turn round
  touched();
  return went;
}

function pan(dx, dy) {
  const px = Math.hypot(...plus(target, here.eye, -1)) / here.fx / fit();
  const move = plus(times(here.right, -dx * px), here.down, -dy * px), next = plus(target, move);
  const away = (at) => Math.hypot(...plus(at, center, -1));
  if (limited && away(next) > reach.aside && away(next) > away(target)) return;
  [here.eye, target] = [plus(here.eye, move), next];
  touched();
}

function zoom(factor) {
  const arm = plus(here.eye, target, -1), length = Math.hypot(...arm);
  const next = limited ? clamp(length * factor, Math.min(reach.least, length), Math.max(reach.most, length)) : length * factor;
  here.eye = plus(target, arm, next / length);
  touched();
}

function told() {
  // Says when the visitor sees what no photograph shows.
  const arm = plus(here.eye, center, -1), away = Math.hypot(...arm);
  const angles = eyes.map((eye) => {
    const a = plus(eye, center, -1);
    return Math.acos(clamp(dot(a, arm) / Math.max(Math.hypot(...a) * away, 1e-12), -1, 1));
  });
  const nearest = Math.min(...eyes.map((eye) => Math.hypot(...plus(eye, here.eye, -1))));
  const lost = facts.subject.object ? away > radius && Math.min(...angles) > 0.5 : nearest > 0.75 * facts.unit;
  $("note").hidden = !lost;
}
