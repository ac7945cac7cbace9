// The mesh, turned by mouse, finger or arrow keys. WebGL 2, no network, no libraries.
"use strict";

const minus = (a, b) => a.map((x, i) => x - b[i]), dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / Math.max(Math.hypot(...a), 1e-12));

const VERTEX = `#version 300 es
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 paint;
uniform vec3 low, size, eye, right, down, ahead;
uniform vec2 lens;
uniform float near;
out vec3 at, color;
void main() {
  at = low + place * size - eye;
  float depth = dot(at, ahead);
  gl_Position = vec4(lens * vec2(dot(at, right), -dot(at, down)), depth - 2.0 * near, depth);
  color = paint;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 at, color;
uniform bool clay, isTextured;
uniform sampler2D image;
out vec4 shown;
void main() {
  float facing = abs(dot(normalize(cross(dFdx(at), dFdy(at))), normalize(at)));
  vec3 base = isTextured ? texture(image, color.xy).rgb : color;
  shown = vec4(clay ? vec3(0.84, 0.84, 0.87) * (0.25 + 0.75 * facing) : base * (0.8 + 0.2 * facing), 1.0);
}`;

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

function program(gl) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw Error(gl.getProgramInfoLog(made));
  return made;
}

async function turnable(figure) {
  const orbit = JSON.parse(figure.dataset.orbit), canvas = figure.querySelector("canvas");
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) return;
  const data = await unpacked(figure.querySelector(".packed").textContent), used = program(gl);
  const length = new DataView(data).getUint32(0, true); // the format is that of meshing/web_mesh.py
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const isPainted = header.paint !== "none", isTextured = header.paint === "texture";
  const places = 4 + length + 12 * header.faces, colors = places + 6 * header.vertices;
  const buffer = (target, begin, end) => {
    gl.bindBuffer(target, gl.createBuffer());
    gl.bufferData(target, new Uint8Array(data, begin, end - begin), gl.STATIC_DRAW);
  };
  buffer(gl.ELEMENT_ARRAY_BUFFER, 4 + length, places);
  buffer(gl.ARRAY_BUFFER, places, colors);
  gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, 6, 0);
  gl.enableVertexAttribArray(0);
  if (isPainted) {
    const [numbers, type, bytes] = isTextured ? [2, gl.UNSIGNED_SHORT, 4] : [3, gl.UNSIGNED_BYTE, 3];
    const end = colors + bytes * header.vertices;
    buffer(gl.ARRAY_BUFFER, colors, end);
    gl.vertexAttribPointer(1, numbers, type, true, bytes, 0);
    gl.enableVertexAttribArray(1);
    if (isTextured) {
      const image = await createImageBitmap(new Blob([new Uint8Array(data, end)], { type: "image/jpeg" }));
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
      gl.generateMipmap(gl.TEXTURE_2D);
    }
  }
  gl.useProgram(used);
  const uniform = (name) => gl.getUniformLocation(used, name);
  gl.uniform1i(uniform("isTextured"), isTextured);

  // The eye in spherical coordinates about the centre.
  const up = unit(orbit.up), arm = minus(orbit.eye, orbit.center), distance = Math.hypot(...arm);
  const level = unit(minus(arm, up.map((x) => x * dot(arm, up)))), side = cross(up, level);
  const start = [0, Math.asin(Math.max(-0.99, Math.min(0.99, dot(unit(arm), up))))];
  const tangent = Math.min(1, Math.max(0.25, orbit.radius / distance)); // half of the smaller field of view
  let [turn, rise] = start, clay = !isPainted;

  function draw() {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    [canvas.width, canvas.height] = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, Math.round(x * ratio)));
    const around = level.map((x, i) => Math.cos(turn) * x + Math.sin(turn) * side[i]);
    const out = around.map((x, i) => Math.cos(rise) * x + Math.sin(rise) * up[i]);
    const ahead = out.map((x) => -x), right = unit(cross(ahead, up)), down = cross(ahead, right);
    const shorter = Math.min(canvas.width, canvas.height) / tangent;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const eye = out.map((x, i) => orbit.center[i] + distance * x);
    for (const [name, value] of Object.entries({ low: header.low, size: header.size, eye, right, down, ahead }))
      gl.uniform3f(uniform(name), ...value);
    gl.uniform2f(uniform("lens"), shorter / canvas.width, shorter / canvas.height);
    gl.uniform1f(uniform("near"), 0.01 * orbit.radius);
    gl.uniform1i(uniform("clay"), clay);
    gl.drawElements(gl.TRIANGLES, 3 * header.faces, gl.UNSIGNED_INT, 0);
    figure.dataset.drawn = `${turn.toFixed(3)} ${rise.toFixed(3)}`;
  }
  function by(x, y) {
    [turn, rise] = [turn + x, Math.max(-1.5, Math.min(1.5, rise + y))];
    requestAnimationFrame(draw);
  }
  canvas.onpointerdown = (e) => canvas.setPointerCapture(e.pointerId);
  canvas.onpointermove = (e) => canvas.hasPointerCapture(e.pointerId) && by(-0.008 * e.movementX, 0.008 * e.movementY);
  canvas.ondblclick = () => by(start[0] - turn, start[1] - rise);
  canvas.onkeydown = (e) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (step) by(...step), e.preventDefault();
  };
  const button = figure.querySelector("button.shape");
  button.onclick = () => {
    clay = !clay;
    button.setAttribute("aria-pressed", clay);
    draw();
  };
  for (const part of [canvas, figure.querySelector(".drag")]) part.hidden = false;
  button.hidden = !isPainted;
  figure.querySelector(".stage p").remove();
  new ResizeObserver(draw).observe(canvas);
  draw();
}

for (const figure of document.querySelectorAll("figure.mesh")) turnable(figure).catch((error) => console.warn(error));
