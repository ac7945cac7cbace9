#version 300 es
// Blended splats over the background; normals and depths as colours over white.
precision highp float;
precision highp int;
uniform sampler2D blended;
uniform vec3 background;
uniform vec2 canvas;  // px
uniform int kind;
out vec4 color;

vec3 depthColor(float t) {  // from near to far, as in report/color_maps.py
    vec3 s[5] = vec3[](vec3(0.99, 0.91, 0.60), vec3(0.60, 0.81, 0.47), vec3(0.16, 0.60, 0.56), vec3(0.17, 0.36, 0.56),
                       vec3(0.19, 0.11, 0.36));
    float at = 4.0 * clamp(t, 0.0, 1.0);
    int i = min(int(at), 3);
    return mix(s[i], s[i + 1], at - float(i));
}

void main() {
    vec4 c = texture(blended, gl_FragCoord.xy / canvas);
    vec3 front = c.rgb, behind = background;
    if (kind == 1) {
        vec3 n = 2.0 * c.rgb - c.a;
        front = c.a * (0.5 + 0.5 * n / max(length(n), 1e-6));
        behind = vec3(1.0);
    } else if (kind == 2) {
        front = c.a * depthColor(c.r / max(c.a, 1e-6));
        behind = vec3(1.0);
    }
    color = vec4(clamp(front + (1.0 - c.a) * behind, 0.0, 1.0), 1.0);
}
