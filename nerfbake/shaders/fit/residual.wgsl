// The residual of each pixel, with its limits, and sums over the picture. A thread for each pixel. WGSL.
// Paste rays.wgsl above this file.
//
//   totals  16 uint32 for each slot: seven sums of 64 bits with 2^20 steps a unit, lower halves first: the squared
//           residuals of the colours; for each channel of the pixels with alpha 1 target times rendered colour, and the
//           rendered colour squared. The last word is not 0 if a sum of a cell came near its range
const NEAR = 64u;  // pixels over which a mean residual runs
const SUMS = 7;
const STEPS = 1048576.0;

@group(1) @binding(7) var<storage, read_write> totals: array<atomic<u32>>;

var<workgroup> around: array<vec3f, 128>;  // the residuals of the workgroup's pixels and of 32 on each side
var<workgroup> counted: array<array<f32, SUMS>, 64>;

fn residualOf(pixel: u32) -> vec4f {
    if pixel >= view.pixels { return vec4f(0.0); }
    let count = view.samples * view.samples;
    let each = select(1u, 2u, view.losses.z > 0.0);
    var seen = vec4f(0.0);
    for (var ray = 0u; ray < count; ray++) {
        let own = rays[each * (pixel * count + ray)];
        seen += vec4f(own.rgb, 1.0 - own.a);
    }
    return targetOf(pixel) - seen / f32(count);
}

@compute @workgroup_size(64)
fn residual(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let first = 64u * (group.y * groups.x + group.x);
    let pixel = first + lane;
    // Pixels before the first one have numbers that wrap around, so they are above the last one.
    around[lane] = residualOf(first + lane - NEAR / 2u).rgb;
    around[lane + 64u] = residualOf(first + lane + NEAR / 2u).rgb;
    workgroupBarrier();
    var mean = vec3f(0.0);
    for (var k = 0u; k < NEAR; k++) { mean += around[lane + k]; }
    mean = abs(mean) / f32(NEAR);
    var own = residualOf(pixel);
    if (view.flags & COUNTED) != 0u { addSums(pixel, own.rgb, lane); }
    let largest = max(abs(own.r), max(abs(own.g), abs(own.b)));
    let middle = max(mean.r, max(mean.g, mean.b));
    var scale = 1.0;
    if largest > view.limits.x { scale = view.limits.x / largest; }
    if middle > view.limits.y { scale = min(scale, view.limits.y / middle); }
    if pixel < view.pixels { residuals[pixel] = vec4f(own.rgb * scale, own.a); }
}

// Add the sums of the workgroup's pixels to the totals.
fn addSums(pixel: u32, residual: vec3f, lane: u32) {
    for (var k = 0; k < SUMS; k++) { counted[lane][k] = 0.0; }
    if pixel < view.pixels {
        counted[lane][0] = dot(residual, residual);
        let wanted = targetOf(pixel);
        if wanted.a >= 1.0 {
            let rendered = wanted.rgb - residual;
            for (var k = 0; k < 3; k++) {
                counted[lane][1 + k] = wanted[k] * rendered[k];
                counted[lane][4 + k] = rendered[k] * rendered[k];
            }
        }
    }
    workgroupBarrier();
    if lane < u32(SUMS) {
        var sum = 0.0;
        for (var k = 0; k < 64; k++) { sum += counted[k][lane]; }
        let steps = u32(clamp(round(sum * STEPS), 0.0, 4.29e9));
        let at = 16u * view.slot + 2u * lane;
        let before = atomicAdd(&totals[at], steps);
        if before + steps < before { atomicAdd(&totals[at + 1u], 1u); }
    }
}
