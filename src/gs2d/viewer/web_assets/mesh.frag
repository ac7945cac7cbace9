#version 300 es
// Unlit: the light of the images is in the colours.
precision highp float;

in vec3 at, painted;
uniform vec3 boxLow, boxHigh;
uniform sampler2D atlas;
uniform bool textured;
out vec4 color;

void main() {
    if (any(lessThan(at, boxLow)) || any(greaterThan(at, boxHigh))) discard;
    vec3 curved = 1.055 * pow(painted, vec3(1.0 / 2.4)) - 0.055;  // sRGB
    vec3 srgb = mix(curved, 12.92 * painted, lessThan(painted, vec3(0.0031308)));
    color = vec4(textured ? texture(atlas, painted.xy).rgb : srgb, 1.0);
}
