#version 300 es
// Colours of the mesh without shading, or grey with the shape only.
precision highp float;
precision highp int;

in vec3 position, positionCam, painted;
uniform vec3 cropLow, cropHigh;
uniform float cropped;
uniform int paint;  // 0 none, 1 vertex colours, 2 texture
uniform int kind;   // 0 colours, otherwise shape only
uniform sampler2D image;
out vec4 color;

void main() {
    if (cropped > 0.5 && (any(lessThan(position, cropLow)) || any(greaterThan(position, cropHigh)))) discard;
    float facing = abs(dot(normalize(cross(dFdx(positionCam), dFdy(positionCam))), normalize(positionCam)));
    vec3 shape = vec3(0.84, 0.84, 0.87) * (0.25 + 0.75 * facing);
    color = vec4(paint == 0 || kind != 0 ? shape : paint == 1 ? painted : texture(image, painted.xy).rgb, 1.0);
}
