#version 300 es
// A vertex of the mesh, projected like the splats.
precision highp float;

layout(location = 0) in vec3 place;  // in the box of the mesh, 0 to 1
layout(location = 1) in vec3 paint;  // colour, or texture coordinates
uniform vec3 boxLow, boxSize;        // relative to the page's origin
uniform mat3 R;                      // world to camera
uniform vec3 t;                      // x_cam = R x + t
uniform vec4 intrinsics;             // fx, fy, cx, cy, px
uniform vec2 size;                   // of the image, px
uniform float near;

out vec3 position, positionCam, painted;

void main() {
    position = boxLow + place * boxSize;
    positionCam = R * position + t;
    vec3 p = positionCam;
    vec2 side = 2.0 * (intrinsics.xy * p.xy + intrinsics.zw * p.z) / size - p.z;
    gl_Position = vec4(side.x, -side.y, p.z - 2.0 * near, p.z);
    painted = paint;
}
