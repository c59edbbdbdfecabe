// The specular colour of a baked atlas. GLSL ES 3.00 (WebGL 2) and GLSL 3.30. Paste this file above main().
// tests/shaders/test_atlas.py runs the same steps in NumPy and compares them with nerfbake's own lookups, texel by
// texel.
//
//   atlas      atlas_{c}.png, LINEAR, CLAMP_TO_EDGE, no mips, RGB8 (not sRGB)
//   labels     labels_{c}.png, NEAREST, no mips, RGB8
//   features   features_{c}.png, NEAREST, no mips, RGB8; affine and grid only
//   uv         texture coordinates of the mesh, v down as in glTF: upload the PNGs without flipping them
//   direction  unit vector from the camera to the surface point, in the mesh's own coordinates, y up
//   colour = clamp(diffuse + specular, 0, 1); all three are display values (sRGB), not linear light
#ifndef NERFBAKE_ATLAS_GLSL
#define NERFBAKE_ATLAS_GLSL
precision highp float;
precision highp sampler2D;

struct Atlas {
    float mapSize;      // atlas.json: map_size
    float border;       // border, 1 or more
    float tilesPerRow;  // tiles_per_row
    float slope;        // slope; affine only
    float n;            // n; grid only
};

vec2 octahedron(vec3 d) {
    vec3 p = d / (abs(d.x) + abs(d.y) + abs(d.z));
    vec2 folded = (1.0 - abs(p.zx)) * vec2(p.x < 0.0 ? -1.0 : 1.0, p.z < 0.0 ? -1.0 : 1.0);
    return (p.y >= 0.0 ? p.xz : folded) * 0.5 + 0.5;
}

vec3 tile(sampler2D atlas, Atlas a, float index, vec2 octahedral) {
    float row = floor((index + 0.5) / a.tilesPerRow);
    vec2 corner = vec2(index - row * a.tilesPerRow, row) * (a.mapSize + 2.0 * a.border) + a.border;
    return texture(atlas, (corner + octahedral * a.mapSize) / vec2(textureSize(atlas, 0))).rgb;
}

float label(vec3 texel) {
    return floor(texel.r * 255.0 + 0.5) + 256.0 * floor(texel.g * 255.0 + 0.5);
}

vec3 specularKmeans(sampler2D atlas, sampler2D labels, Atlas a, vec2 uv, vec3 direction) {
    return tile(atlas, a, label(texture(labels, uv).rgb), octahedron(direction));
}

vec3 specularAffine(sampler2D atlas, sampler2D labels, sampler2D features, Atlas a, vec2 uv, vec3 direction) {
    vec3 texel = texture(labels, uv).rgb;
    float first = 4.0 * label(texel);
    vec2 at = octahedron(direction);
    vec3 offset = (texture(features, uv).rgb - 127.0 / 255.0) * a.slope * texel.b * 255.0 / 127.0;
    vec3 colour = tile(atlas, a, first, at);
    colour += offset.r * (tile(atlas, a, first + 1.0, at) - 128.0 / 255.0);
    colour += offset.g * (tile(atlas, a, first + 2.0, at) - 128.0 / 255.0);
    return colour + offset.b * (tile(atlas, a, first + 3.0, at) - 128.0 / 255.0);
}

vec3 specularGrid(sampler2D atlas, sampler2D features, Atlas a, vec2 uv, vec3 direction) {
    vec2 at = octahedron(direction);
    vec3 p = texture(features, uv).rgb * (a.n - 1.0);
    vec3 low = min(floor(p), a.n - 2.0);
    vec3 f = p - low;
    // Sort the axes by decreasing fraction; of equal ones, the first comes first.
    vec3 before = vec3(f.g > f.r, f.r >= f.g, f.r >= f.b) + vec3(f.b > f.r, f.b > f.g, f.g >= f.b);
    vec3 stride = vec3(a.n * a.n, a.n, 1.0);
    vec3 first = vec3(equal(before, vec3(0.0))), second = vec3(equal(before, vec3(1.0)));
    float f0 = dot(first, f), f1 = dot(second, f), f2 = dot(1.0 - first - second, f);
    float node = dot(low, stride);
    vec3 colour = (1.0 - f0) * tile(atlas, a, node, at);
    node += dot(first, stride);
    colour += (f0 - f1) * tile(atlas, a, node, at);
    node += dot(second, stride);
    colour += (f1 - f2) * tile(atlas, a, node, at);
    node += dot(1.0 - first - second, stride);
    return colour + f2 * tile(atlas, a, node, at);
}
#endif  // NERFBAKE_ATLAS_GLSL
