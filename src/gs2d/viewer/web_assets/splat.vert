#version 300 es
// One splat: its record (docs/math.md, "Projection"), its colour, and the corner of its screen box (rule 14).
precision highp float;
precision highp int;
precision highp usampler2D;

layout(location = 0) in uint row;  // of the splat; instanced
uniform usampler2D splats, harmonics;
uniform mat3 R;                    // world to camera
uniform vec3 t, eye;               // x_cam = R x + t; the camera centre
uniform vec4 intrinsics;           // fx, fy, cx, cy, px
uniform vec2 size;                 // of the image, px
uniform float near, alphaMin, lowpass, mip, crossingCutoff;  // lowpass, mip: px
uniform int degree, texels;        // SH degree; texels of SH coefficients per splat
uniform int nearPlanePolicy;       // 0 draw, 1 cull, 2 box
uniform int kind;                  // 0 colours, 1 normals, 2 depth
uniform vec3 cropLow, cropHigh;
uniform float cropped;             // 0 draws everything; 1 hides splats outside the crop box and spikes
uniform float scales[15];          // of the 8-bit SH coefficients

flat out vec2 center;
flat out vec4 planes;              // au, bu, av, bv
flat out vec3 inverseDepth;        // ai, bi, 1 / z_c
flat out vec4 paint;               // colour or normal, opacity

const int WIDTH = 2048;
const vec4 NOWHERE = vec4(2.0, 2.0, 2.0, 1.0);
const vec2 LARGE = vec2(0.7, 1.2);  // half widths, relative to the shorter side of the image, at which splats fade

uvec4 texel(usampler2D from, int i) { return texelFetch(from, ivec2(i % WIDTH, i / WIDTH), 0); }

vec3 coefficient(int k) {  // SH coefficient k >= 1
    vec3 c;
    for (int channel = 0; channel < 3; ++channel) {
        int at = 3 * (k - 1) + channel;
        uvec4 words = texel(harmonics, int(row) * texels + at / 16);
        int byte = int(words[(at / 4) % 4] << uint(24 - 8 * (at % 4))) >> 24;
        c[channel] = float(byte) / 127.0;
    }
    return c * scales[k - 1];
}

vec3 colorAlong(vec3 d, vec3 sh0) {  // kernels/core/sh.h
    vec3 c = vec3(0.5) + 0.28209479177387814 * sh0;
    if (degree < 1) return max(c, 0.0);
    float x = d.x, y = d.y, z = d.z;
    c += 0.4886025119029199 * (-y * coefficient(1) + z * coefficient(2) - x * coefficient(3));
    if (degree < 2) return max(c, 0.0);
    float xx = x * x, yy = y * y, zz = z * z;
    c += 1.0925484305920792 * (x * y * coefficient(4) - y * z * coefficient(5) - x * z * coefficient(7));
    c += 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(6) + 0.5462742152960396 * (xx - yy) * coefficient(8);
    if (degree < 3) return max(c, 0.0);
    float fourZZ = 4.0 * zz - xx - yy;
    c += 0.5900435899266435 * (-y * (3.0 * xx - yy) * coefficient(9) - x * (xx - 3.0 * yy) * coefficient(15));
    c += 0.4570457994644658 * fourZZ * (-y * coefficient(11) - x * coefficient(13));
    c += 2.890611442640554 * x * y * z * coefficient(10) + 1.445305721320277 * z * (xx - yy) * coefficient(14);
    c += 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(12);
    return max(c, 0.0);
}

// Centre (relative to the projected mean) and half width of a disc of k standard deviations along one image axis.
vec2 extent(float f, float c0, float c, vec2 across, vec2 depths, float kk, float ww) {
    vec2 A = f * across + (c0 - c) * depths;
    float middle = kk * dot(A, depths) / ww;
    return vec2(middle, sqrt(max(middle * middle - kk * dot(A, A) / ww, 0.0)));
}

void main() {
    gl_Position = NOWHERE;
    uvec4 first = texel(splats, 2 * int(row)), second = texel(splats, 2 * int(row) + 1);
    vec3 mean = uintBitsToFloat(first.xyz);
    vec2 redGreen = unpackHalf2x16(second.z), blueOpacity = unpackHalf2x16(second.w);
    bool isSpike = blueOpacity.y < 0.0;  // the mark of viewer/packed_splats.py
    bool isOutside = isSpike || any(lessThan(mean, cropLow)) || any(greaterThan(mean, cropHigh));
    if (isOutside && cropped == 1.0) return;
    vec2 s = exp(unpackHalf2x16(first.w));
    vec4 q = normalize(vec4(unpackSnorm2x16(second.x), unpackSnorm2x16(second.y)));  // w, x, y, z
    float opacity = abs(blueOpacity.y);
    vec3 p = R * mean + t;
    if (!(p.z > near) || !(opacity >= alphaMin)) return;

    float w = q.x, x = q.y, y = q.z, z = q.w;
    vec3 tu = R * vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y));
    vec3 tv = R * vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x));
    vec3 n = cross(tu, tv), a = s.x * tu, b = s.y * tv;
    center = intrinsics.xy * p.xy / p.z + intrinsics.zw;
    float facing = dot(n, p), least = 1e-7 * length(p);
    float inverse = 1.0 / (abs(facing) >= least ? facing : facing < 0.0 ? -least : least);
    vec2 f = 1.0 / intrinsics.xy;
    planes = inverse * vec4(f * cross(tv, p).xy / s.x, f * cross(p, tu).xy / s.y);
    inverseDepth = vec3(f * inverse * n.xy, 1.0 / p.z);
    if (mip > 0.0) {  // kernels/core/mip_filter.h
        float variance = mip * mip * p.z * p.z, area = variance * (planes.x * planes.w - planes.y * planes.z);
        float uu = dot(planes.xy, planes.xy), vv = dot(planes.zw, planes.zw), l11 = sqrt(1.0 + variance * uu);
        float l21 = variance * dot(planes.xy, planes.zw) / l11;
        float l22 = sqrt(1.0 + variance * (uu + vv) + area * area) / l11;
        planes.xy /= l11;
        planes.zw = (planes.zw - l21 * planes.xy) / l22;
        opacity /= l11 * l22;
        a = l11 * a + l21 * b;
        b *= l22;
        if (!(opacity >= alphaMin)) return;
    }

    float kk = 2.0 * log(opacity / alphaMin), k = sqrt(kk);
    vec2 depths = vec2(a.z, b.z);
    float steep = dot(depths, depths);
    bool crosses = crossingCutoff * crossingCutoff * steep >= p.z * p.z;
    float hidden = isOutside || crosses || kk * steep >= p.z * p.z ? 1.0 : 0.0;
    vec2 low = vec2(0.0), high = size;
    if (crosses && nearPlanePolicy == 1) return;
    if (crosses && nearPlanePolicy == 2) kk = crossingCutoff * crossingCutoff;
    if (kk * steep < p.z * p.z || (crosses && nearPlanePolicy == 2)) {
        float ww = kk * steep - p.z * p.z;
        vec2 h = extent(intrinsics.x, intrinsics.z, center.x, vec2(a.x, b.x), depths, kk, ww);
        vec2 v = extent(intrinsics.y, intrinsics.w, center.y, vec2(a.y, b.y), depths, kk, ww);
        hidden = max(hidden, smoothstep(LARGE.x, LARGE.y, max(h.y, v.y) / min(size.x, size.y)));
        if (crosses) {  // the official rasterizer's square, in whole tiles
            vec2 middle = center + vec2(h.x, v.x);
            float side = ceil(max(max(h.y, v.y), lowpass * crossingCutoff));
            low = max(low, 16.0 * floor((middle - side) / 16.0));
            high = min(high, 16.0 * floor((middle + side + 15.0) / 16.0));
        } else {
            low = max(low, center + min(vec2(h.x - h.y, v.x - v.y), -lowpass * k));
            high = min(high, center + max(vec2(h.x + h.y, v.x + v.y), lowpass * k));
        }
    }
    opacity *= 1.0 - cropped * hidden;
    if (any(greaterThanEqual(low, high)) || opacity < alphaMin) return;


    vec3 toSplat = mean - eye;
    if (kind == 1) {
        vec3 normal = (facing > 0.0 ? -n : n) * R;  // n R = R^T n: back to the world
        paint = vec4(0.5 + 0.5 * normal, opacity);
    } else if (kind == 0) {
        paint = vec4(colorAlong(normalize(toSplat), vec3(redGreen, blueOpacity.x)), opacity);
    } else {
        paint = vec4(vec3(0.0), opacity);
    }
    vec2 corner = mix(low, high, vec2(gl_VertexID & 1, gl_VertexID >> 1)) / size;
    gl_Position = vec4(2.0 * corner.x - 1.0, 1.0 - 2.0 * corner.y, 0.0, 1.0);
}
