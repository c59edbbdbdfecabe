// The specular colour of a baked atlas. HLSL, shader model 5.
//
//   atlas      atlas_{c}.png, no mips, RGB8 (not sRGB), sampler `smoothly`: linear filter, clamped
//   labels     labels_{c}.png, no mips, RGB8, sampler `nearest`: point filter
//   features   features_{c}.png, no mips, RGB8, sampler `nearest`; affine and grid only
//   uv         texture coordinates of the mesh, v down as in glTF: upload the PNGs without flipping them
//   direction  unit vector from the camera to the surface point, in the mesh's own coordinates, y up
//   colour = clamp(diffuse + specular, 0, 1); all three are display values (sRGB), not linear light
#ifndef NERFBAKE_ATLAS_HLSL
#define NERFBAKE_ATLAS_HLSL
Texture2D<float4> atlas;
Texture2D<float4> labels;
Texture2D<float4> features;
SamplerState smoothly;
SamplerState nearest;

struct Atlas {
    float mapSize;      // atlas.json: map_size
    float border;       // border, 1 or more
    float tilesPerRow;  // tiles_per_row
    float slope;        // slope; affine only
    float n;            // n; grid only
};

float2 octahedron(float3 d) {
    float3 p = d / (abs(d.x) + abs(d.y) + abs(d.z));
    float2 folded = (1.0 - abs(p.zx)) * float2(p.x < 0.0 ? -1.0 : 1.0, p.z < 0.0 ? -1.0 : 1.0);
    if (p.y >= 0.0) folded = p.xz;
    return folded * 0.5 + 0.5;
}

float3 tile(Atlas a, float index, float2 octahedral) {
    float row = floor((index + 0.5) / a.tilesPerRow);
    float2 corner = float2(index - row * a.tilesPerRow, row) * (a.mapSize + 2.0 * a.border) + a.border;
    float width, height;
    atlas.GetDimensions(width, height);
    return atlas.SampleLevel(smoothly, (corner + octahedral * a.mapSize) / float2(width, height), 0.0).rgb;
}

float label(float3 texel) {
    return floor(texel.r * 255.0 + 0.5) + 256.0 * floor(texel.g * 255.0 + 0.5);
}

float3 specularKmeans(Atlas a, float2 uv, float3 direction) {
    return tile(a, label(labels.SampleLevel(nearest, uv, 0.0).rgb), octahedron(direction));
}

float3 specularAffine(Atlas a, float2 uv, float3 direction) {
    float3 texel = labels.SampleLevel(nearest, uv, 0.0).rgb;
    float first = 4.0 * label(texel);
    float2 at = octahedron(direction);
    float3 feature = features.SampleLevel(nearest, uv, 0.0).rgb;
    float3 offset = (feature - 127.0 / 255.0) * a.slope * texel.b * 255.0 / 127.0;
    float3 colour = tile(a, first, at);
    colour += offset.r * (tile(a, first + 1.0, at) - 128.0 / 255.0);
    colour += offset.g * (tile(a, first + 2.0, at) - 128.0 / 255.0);
    return colour + offset.b * (tile(a, first + 3.0, at) - 128.0 / 255.0);
}

float3 specularGrid(Atlas a, float2 uv, float3 direction) {
    float2 at = octahedron(direction);
    float3 p = features.SampleLevel(nearest, uv, 0.0).rgb * (a.n - 1.0);
    float3 low = min(floor(p), a.n - 2.0);
    float3 f = p - low;
    // Sort the axes by decreasing fraction; of equal ones, the first comes first.
    float3 before = float3(f.g > f.r, f.r >= f.g, f.r >= f.b) + float3(f.b > f.r, f.b > f.g, f.g >= f.b);
    float3 stride = float3(a.n * a.n, a.n, 1.0);
    float3 first = float3(before == 0.0), second = float3(before == 1.0);
    float f0 = dot(first, f), f1 = dot(second, f), f2 = dot(1.0 - first - second, f);
    float node = dot(low, stride);
    float3 colour = (1.0 - f0) * tile(a, node, at);
    node += dot(first, stride);
    colour += (f0 - f1) * tile(a, node, at);
    node += dot(second, stride);
    colour += (f1 - f2) * tile(a, node, at);
    node += dot(1.0 - first - second, stride);
    return colour + f2 * tile(a, node, at);
}
#endif  // NERFBAKE_ATLAS_HLSL
