#version 300 es
// A vertex of the mesh, with the camera of the splats.
precision highp float;

layout(location = 0) in vec3 place;  // relative to the page's origin
layout(location = 1) in vec3 paint;  // linear colour, or texture coordinates
uniform mat3 turn;                   // world to camera
uniform vec3 shift;                  // x_cam = turn x + shift
uniform vec4 lens;                   // fx, fy, cx, cy, px
uniform vec2 size;                   // of the image, px
uniform float near;

out vec3 at, painted;

void main() {
    vec3 p = turn * place + shift;
    vec2 side = 2.0 * (lens.xy * p.xy + lens.zw * p.z) / size - p.z;
    gl_Position = vec4(side.x, -side.y, p.z - 2.0 * near, p.z);
    at = place;
    painted = paint;
}
