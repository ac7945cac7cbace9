// The mesh, with vertex colours or with a texture.
const meshes = {}; // by name, once they are requested: null until they are there
const QUANTIZATION_STEPS = 65535;

async function loadMesh(name) {
  // A block of meshing/web_mesh.py.
  const data = await dataOf(name), length = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  let begin = 4 + length;
  const next = (numbers, count) => {
    const array = new numbers(data, begin, count);
    begin += array.byteLength;
    return array;
  };
  const mesh = { ...compile("mesh.vert", "mesh.frag"), count: 3 * header.faces, array: gl.createVertexArray(), paint: header.paint };
  const faces = next(Uint32Array, mesh.count), { program, at } = mesh;
  gl.bindVertexArray(mesh.array);
  const attribute = (i, values, size, type) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, size, type, true, 0, 0);
  };
  attribute(0, next(Uint16Array, 3 * header.vertices), 3, gl.UNSIGNED_SHORT);
  if (mesh.paint === "texture") attribute(1, next(Uint16Array, 2 * header.vertices), 2, gl.UNSIGNED_SHORT);
  else if (mesh.paint === "color") attribute(1, next(Uint8Array, 3 * header.vertices), 3, gl.UNSIGNED_BYTE);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  gl.useProgram(program);
  gl.uniform3f(at.boxLow, ...plus(header.low, facts.origin, -1));
  gl.uniform3f(at.boxSize, ...header.size);
  gl.uniform1f(at.near, facts.near);
  gl.uniform1i(at.paint, ["none", "color", "texture"].indexOf(mesh.paint));
  if (mesh.paint === "texture") {
    const image = await createImageBitmap(new Blob([new Uint8Array(data, begin)], { type: "image/jpeg" }));
    mesh.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, mesh.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    gl.generateMipmap(gl.TEXTURE_2D);
  }
  meshes[name] = mesh;
  showStatus("");
  redraw();
}

function drawMesh() {
  if (!(shows in meshes)) {
    meshes[shows] = null;
    showStatus("Loading the mesh ...");
    loadMesh(shows).catch((error) => showStatus(error.message));
  }
  const mesh = meshes[shows];
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(...facts.background, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  if (!mesh) return;
  gl.disable(gl.BLEND);
  gl.enable(gl.DEPTH_TEST);
  useCamera(mesh, canvas.width, canvas.height);
  gl.uniform1i(mesh.at.kind, kind);
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, mesh.texture || null);
  gl.bindVertexArray(mesh.array);
  gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 0);
  gl.bindVertexArray(null);
  gl.disable(gl.DEPTH_TEST);
}
