// Draws splats as gs2d renders them: discs intersected by rays, blended from back to front, with WebGL 2.
const TEXELS = 2048; // per row of the textures
const REST = 250; // ms without motion until the full image is drawn
const MOVING_SPLATS = 500_000; // drawn during motion at most; they are stored by importance
const MIN_MOVING_SPLATS = 50_000;
const FADE = 250; // ms in which cropped splats disappear

const canvas = $("canvas");
const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, powerPreference: "high-performance" });
const isTouch = matchMedia("(pointer: coarse)").matches;
let splatProgram, finalProgram, splatTable, shTable, orderBuffer, frameBuffer, blended, blendedSize = "";
let shows = "splats", kind = 0; // what is shown; 0 colours, 1 normals, 2 depth
let depthRange = [0, 1], fixedRange, sample; // depths at the ends of the colour scale; some of the means
let count = 0, drawn = 0, wanted = 0, isSorting = false, isScheduled = false, lastMotion = 0, lastState = "";
let scale = 1, movingLimit = MOVING_SPLATS; // during motion: resolution relative to the canvas, splats
let cropped = 1, lastFrame = 0; // 0: nothing is cropped; 1: all that is outside is hidden
const worker = new Worker(URL.createObjectURL(new Blob([$("sorter").textContent], { type: "text/javascript" })));

function compile(vertex, fragment) {
  const program = gl.createProgram();
  for (const [type, id] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, $(id).textContent.trim());
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw Error(gl.getProgramInfoLog(program));
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); ++i) {
    const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
    at[name] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}

function tableOf(buffer, begin, texels) {
  // Words as a texture of unsigned integers, padded to whole rows.
  const height = Math.max(1, Math.ceil(texels / TEXELS)), words = new Uint32Array(4 * TEXELS * height);
  words.set(new Uint32Array(buffer, begin, 4 * texels));
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, TEXELS, height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
  return texture;
}

function load(buffer) {
  // Takes the splats that `facts` describes.
  const n = facts.splats, { program, at } = splatProgram;
  gl.deleteTexture(splatTable || null);
  gl.deleteTexture(shTable || null);
  splatTable = tableOf(buffer, 0, 2 * n);
  shTable = tableOf(buffer, 32 * n, facts.texels * n);
  keepRecords(buffer);
  const words = new Float32Array(buffer, 0, 8 * n), means = new Float32Array(3 * n);
  for (let i = 0; i < n; ++i) means.set(words.subarray(8 * i, 8 * i + 3), 3 * i);
  const step = Math.max(1, Math.floor(n / 4000));
  sample = Float32Array.from({ length: 3 * Math.floor(n / step) }, (_, i) => means[3 * step * Math.floor(i / 3) + (i % 3)]);
  worker.postMessage({ means }, [means.buffer]);
  gl.useProgram(program);
  for (const name of ["degree", "texels"]) gl.uniform1i(at[name], facts[name]);
  gl.uniform1fv(at.scales, facts.scales);
  $("count").textContent = n.toLocaleString("en");
  lastState = ""; // sort again
  redraw();
}

worker.onmessage = ({ data }) => {
  isSorting = false;
  count = data.order.length;
  gl.bindBuffer(gl.ARRAY_BUFFER, orderBuffer);
  gl.bufferData(gl.ARRAY_BUFFER, data.order, gl.DYNAMIC_DRAW);
  drawn = data.request;
  redraw();
};

function sort(limit) {
  if (isSorting) return;
  isSorting = true;
  worker.postMessage({ plane: [...camera.ahead, -dot(camera.ahead, camera.eye)], near: facts.near, limit, request: wanted });
}

// ---- frames ----
const fit = () => Math.min(canvas.clientWidth / camera.w, canvas.clientHeight / camera.h); // CSS px per px of the camera

function moved() {
  lastMotion = performance.now();
  redraw();
}

function redraw() {
  document.body.dataset.drawn = "moving";
  if (!isScheduled) requestAnimationFrame(frame);
  isScheduled = true;
}

function frame(now) {
  isScheduled = false;
  const isStill = performance.now() - lastMotion > REST, ratio = Math.min(devicePixelRatio || 1, isTouch ? 1.5 : 2);
  const [W, H] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
  if (canvas.width !== W || canvas.height !== H) [canvas.width, canvas.height] = [W, H];
  const limit = isStill ? facts.splats : Math.min(facts.splats, movingLimit);
  const state = JSON.stringify([camera.ahead, camera.eye, limit]);
  if (state !== lastState) [lastState, wanted] = [state, wanted + 1];
  if (drawn !== wanted) sort(limit);
  const step = Math.min((now - lastFrame) / FADE, 0.2), aim = isCropped() ? 1 : 0;
  cropped = aim > cropped ? Math.min(aim, cropped + step) : Math.max(aim, cropped - step);
  lastFrame = now;
  const began = performance.now(), size = [W, H].map((side) => Math.max(1, Math.round(side * (isStill ? 1 : scale))));
  if (shows === "splats") drawSplats(...size);
  else drawMesh();
  drawCropBox();
  drawRuler();
  drawFrustums();
  if (!isStill) {
    adapt(began);
    setTimeout(redraw, REST + 50); // the full image, once at rest
  }
  $("note").hidden = !isUnseen();
  if (spinning) spin();
  if (cropped !== aim) redraw();
  document.body.dataset.drawn = drawn === wanted && isStill && cropped === aim ? "still" : "moving";
}

function adapt(began) {
  // Resolution and splats during motion, by the time that a frame takes.
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits for the GPU
  const took = performance.now() - began;
  if (took > 60 && scale > 0.4) scale = Math.max(0.4, scale * 0.8);
  else if (took > 60) movingLimit = Math.max(MIN_MOVING_SPLATS, Math.min(movingLimit, facts.splats) * 0.8);
  else if (took < 25) [scale, movingLimit] = [Math.min(1, scale * 1.1), Math.min(MOVING_SPLATS, movingLimit * 1.1)];
}

function resizeBlended(width, height) {
  if (blendedSize === `${width}x${height}`) return;
  blendedSize = `${width}x${height}`;
  gl.bindTexture(gl.TEXTURE_2D, blended);
  const hasFloat = gl.getExtension("EXT_color_buffer_half_float") || gl.getExtension("EXT_color_buffer_float");
  const [format, type] = hasFloat ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
  gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, type, null);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frameBuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, blended, 0);
}

function visibleDepths() {
  // The range of depths of most splats in the image.
  const depths = [];
  for (let i = 0; i < sample.length; i += 3) {
    const mean = [sample[i], sample[i + 1], sample[i + 2]];
    if (isInImage(camera, mean) && isInCrop(mean)) depths.push(dot(plus(mean, camera.eye, -1), camera.ahead));
  }
  depths.sort((a, b) => a - b);
  const at = (share) => depths[Math.round(share * (depths.length - 1))];
  return depths.length > 9 && at(0.97) > at(0.03) ? [at(0.03), at(0.97)] : [facts.near, facts.near + 2 * facts.unit];
}

function useCamera({ program, at }, width, height) {
  // Uses a program, with the camera and the crop box, for an image of this size.
  const s = fit() * (width / canvas.clientWidth), { right, down, ahead, eye } = camera;
  const cx = width / 2 + s * (camera.cx - camera.w / 2), cy = height / 2 + s * (camera.cy - camera.h / 2);
  gl.useProgram(program);
  gl.uniformMatrix3fv(at.R, true, [...right, ...down, ...ahead]);
  gl.uniform3f(at.t, -dot(right, eye), -dot(down, eye), -dot(ahead, eye));
  gl.uniform4f(at.intrinsics, s * camera.fx, s * camera.fy, cx, cy);
  gl.uniform2f(at.size, width, height);
  gl.uniform1f(at.cropped, cropped);
  gl.uniform3f(at.cropLow, ...crop.low);
  gl.uniform3f(at.cropHigh, ...crop.high);
}

function drawSplats(width, height) {
  const { at } = splatProgram;
  resizeBlended(width, height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frameBuffer);
  gl.viewport(0, 0, width, height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  useCamera(splatProgram, width, height);
  gl.uniform3f(at.eye, ...camera.eye);
  gl.uniform1f(at.height, height);
  gl.uniform1i(at.kind, kind);
  if (kind === 2) depthRange = fixedRange || visibleDepths();
  gl.uniform2f(at.range, ...depthRange);
  [splatTable, shTable].forEach((texture, i) => {
    gl.activeTexture(gl.TEXTURE0 + i);
    gl.bindTexture(gl.TEXTURE_2D, texture);
  });
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.disable(gl.BLEND);
  gl.useProgram(finalProgram.program);
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, blended);
  gl.uniform2f(finalProgram.at.canvas, canvas.width, canvas.height);
  gl.uniform1i(finalProgram.at.kind, kind);
  gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
}

function prepareSplats() {
  [splatProgram, finalProgram] = [compile("splat.vert", "splat.frag"), compile("final.vert", "final.frag")];
  [orderBuffer, frameBuffer, blended] = [gl.createBuffer(), gl.createFramebuffer(), gl.createTexture()];
  gl.bindBuffer(gl.ARRAY_BUFFER, orderBuffer);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  const { program, at } = splatProgram;
  gl.useProgram(program);
  gl.uniform1i(at.splats, 0);
  gl.uniform1i(at.harmonics, 1);
  for (const name of ["near", "alphaMin", "alphaMax", "lowpass", "mip", "crossingCutoff"]) gl.uniform1f(at[name], facts[name]);
  gl.uniform1i(at.nearPlanePolicy, facts.nearPlanePolicy);
  gl.useProgram(finalProgram.program);
  gl.uniform3f(finalProgram.at.background, ...facts.background);
}
