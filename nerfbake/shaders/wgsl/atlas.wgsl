// The specular colour of a baked atlas. WGSL.
//
//   atlas      atlas_{c}.png, no mips, rgba8unorm (not sRGB), sampler `smoothly`: linear filter, clamped
//   labels     labels_{c}.png, no mips, rgba8unorm, sampler `nearest`: nearest filter
//   features   features_{c}.png, no mips, rgba8unorm, sampler `nearest`; affine and grid only
//   uv         texture coordinates of the mesh, v down as in glTF: upload the PNGs without flipping them
//   direction  unit vector from the camera to the surface point, in the mesh's own coordinates, y up
//   colour = clamp(diffuse + specular, 0, 1); all three are display values (sRGB), not linear light
@group(1) @binding(10) var atlas: texture_2d<f32>;
@group(1) @binding(11) var labels: texture_2d<f32>;
@group(1) @binding(12) var features: texture_2d<f32>;
@group(1) @binding(13) var smoothly: sampler;
@group(1) @binding(14) var nearest: sampler;

struct Atlas {
    mapSize: f32,      // atlas.json: map_size
    border: f32,       // border, 1 or more
    tilesPerRow: f32,  // tiles_per_row
    slope: f32,        // slope; affine only
    n: f32,            // n; grid only
}

fn octahedron(d: vec3f) -> vec2f {
    let p = d / (abs(d.x) + abs(d.y) + abs(d.z));
    let folded = (1.0 - abs(p.zx)) * select(vec2f(1.0), vec2f(-1.0), p.xz < vec2f(0.0));
    return select(folded, p.xz, p.y >= 0.0) * 0.5 + 0.5;
}

fn tile(a: Atlas, index: f32, octahedral: vec2f) -> vec3f {
    let row = floor((index + 0.5) / a.tilesPerRow);
    let corner = vec2f(index - row * a.tilesPerRow, row) * (a.mapSize + 2.0 * a.border) + a.border;
    let at = (corner + octahedral * a.mapSize) / vec2f(textureDimensions(atlas));
    return textureSampleLevel(atlas, smoothly, at, 0.0).rgb;
}

fn label(texel: vec3f) -> f32 {
    return floor(texel.r * 255.0 + 0.5) + 256.0 * floor(texel.g * 255.0 + 0.5);
}

fn specularKmeans(a: Atlas, uv: vec2f, direction: vec3f) -> vec3f {
    return tile(a, label(textureSampleLevel(labels, nearest, uv, 0.0).rgb), octahedron(direction));
}

fn specularAffine(a: Atlas, uv: vec2f, direction: vec3f) -> vec3f {
    let texel = textureSampleLevel(labels, nearest, uv, 0.0).rgb;
    let first = 4.0 * label(texel);
    let at = octahedron(direction);
    let feature = textureSampleLevel(features, nearest, uv, 0.0).rgb;
    let offset = (feature - 127.0 / 255.0) * a.slope * texel.b * 255.0 / 127.0;
    var colour = tile(a, first, at);
    colour += offset.r * (tile(a, first + 1.0, at) - 128.0 / 255.0);
    colour += offset.g * (tile(a, first + 2.0, at) - 128.0 / 255.0);
    return colour + offset.b * (tile(a, first + 3.0, at) - 128.0 / 255.0);
}

fn specularGrid(a: Atlas, uv: vec2f, direction: vec3f) -> vec3f {
    let at = octahedron(direction);
    let p = textureSampleLevel(features, nearest, uv, 0.0).rgb * (a.n - 1.0);
    let low = min(floor(p), vec3f(a.n - 2.0));
    let f = p - low;
    // Sort the axes by decreasing fraction; of equal ones, the first comes first.
    let before = vec3f(vec3<bool>(f.g > f.r, f.r >= f.g, f.r >= f.b))
        + vec3f(vec3<bool>(f.b > f.r, f.b > f.g, f.g >= f.b));
    let stride = vec3f(a.n * a.n, a.n, 1.0);
    let first = vec3f(before == vec3f(0.0));
    let second = vec3f(before == vec3f(1.0));
    let f0 = dot(first, f);
    let f1 = dot(second, f);
    let f2 = dot(1.0 - first - second, f);
    var node = dot(low, stride);
    var colour = (1.0 - f0) * tile(a, node, at);
    node += dot(first, stride);
    colour += (f0 - f1) * tile(a, node, at);
    node += dot(second, stride);
    colour += (f1 - f2) * tile(a, node, at);
    node += dot(1.0 - first - second, stride);
    return colour + f2 * tile(a, node, at);
}
