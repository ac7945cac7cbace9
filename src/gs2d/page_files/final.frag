#version 300 es
// The background behind what was blended; normals as colours, over white.
precision highp float;
uniform sampler2D blended;
uniform vec3 background;
uniform vec2 canvas;  // px
uniform int kind;
out vec4 color;

void main() {
    vec4 c = texture(blended, gl_FragCoord.xy / canvas);
    vec3 seen = c.rgb, behind = background;
    if (kind == 1) {
        vec3 n = 2.0 * c.rgb - c.a;
        seen = c.a * (0.5 + 0.5 * n / max(length(n), 1e-6));
        behind = vec3(1.0);
    }
    color = vec4(clamp(seen + (1.0 - c.a) * behind, 0.0, 1.0), 1.0);
}
