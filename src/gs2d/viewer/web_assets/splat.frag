#version 300 es
// One splat in one pixel: rules 3 to 6 of the rasterizer's contract, premultiplied.
precision highp float;
precision highp int;

flat in vec2 center;
flat in vec4 planes;
flat in vec3 inverseDepth;
flat in vec4 paint;
uniform vec2 range;                // depths at the ends of the colour scale
uniform int kind;                  // 2: depth instead of colour
uniform float height, near, alphaMin, alphaMax, lowpass;
out vec4 blended;

void main() {
    vec2 d = vec2(gl_FragCoord.x, height - gl_FragCoord.y) - center;
    float rho = dot(d, d) / (lowpass * lowpass), depth = 1.0 / inverseDepth.z;
    float I = inverseDepth.z + dot(inverseDepth.xy, d);
    if (I > 0.0) {
        vec2 uv = vec2(dot(planes.xy, d), dot(planes.zw, d)) / I;
        float onPlane = dot(uv, uv);
        if (onPlane <= rho) rho = onPlane, depth = 1.0 / I;
    }
    float alpha = paint.a * exp(-0.5 * rho);
    if (depth < near || alpha < alphaMin) discard;
    alpha = min(alpha, alphaMax);
    vec3 value = kind == 2 ? vec3((depth - range.x) / (range.y - range.x)) : paint.rgb;
    blended = vec4(alpha * value, alpha);
}
