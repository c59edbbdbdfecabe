// A step of each cell by its sums, which are cleared. A workgroup for each brick. WGSL. Paste cells.wgsl above this file.
//
//   sums     as in march.wgsl
//   means    moving means of each cell's curvature and weight
//   seen     the largest weight, and the sum of weight times residual
//   totals   as in residual.wgsl
//   corners, cornersOf  as in march.wgsl; the curvature of a cell is added to its corners, whose step is corners.wgsl
override smoothed = false;
const DECAY = 0.9;
const FADE = 0.95;
const CURVATURE_FLOOR = 1e-3;
const WEIGHT_FLOOR = 1e-2;
const SLOPE_FLOOR = 0.15;
const MOST_RAW = 12.0;
const RANGE = 1 << 30u;

struct Corner {
    raw: f32,
    mean: f32,
    asked: i32,
    curvature: atomic<i32>,
}

@group(1) @binding(7) var<storage, read_write> totals: array<atomic<u32>>;
@group(1) @binding(8) var<storage, read_write> sums: array<vec4i>;
@group(1) @binding(9) var<storage, read> cornersOf: array<u32>;
@group(1) @binding(10) var<storage, read_write> corners: array<Corner>;
@group(1) @binding(11) var<storage, read_write> means: array<vec2f>;
@group(1) @binding(12) var<storage, read_write> seen: array<vec2f>;

@compute @workgroup_size(64)
fn stepCells(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let number = part.x + group.y * groups.x + group.x;
    if number >= part.y { return; }
    let brick = brickOf(number);
    for (var cell = lane; cell < brick.count; cell += 64u) { stepCell(brick, cell); }
}

fn stepCell(brick: Brick, cell: u32) {
    let row = brick.first + cell;
    if (view.flags & FRESH) != 0u { seen[row].y = 0.0; }
    let low = sums[2u * row];
    let high = sums[2u * row + 1u];
    if all(low == vec4i(0)) && all(high == vec4i(0)) { return; }
    sums[2u * row] = vec4i(0);
    sums[2u * row + 1u] = vec4i(0);
    let weighted = low.w;
    let asked = high.x;
    let curved = high.y;
    let most = f32(high.z) * view.limits.w;
    let unit = view.limits.w * view.rates.w;
    if max(max(abs(curved), abs(weighted)), abs(asked)) > RANGE { atomicMax(&totals[16u * view.slot + 15u], 1u); }

    let place = placeOf(row);
    var mean = means[row];
    let values3 = brick.start + 3u * u32(B) * brick.count + cell;
    if curved > 0 {
        seen[row] = vec2f(max(seen[row].x * FADE, most), seen[row].y + f32(high.w) * unit);
        if smoothed {
            for (var k = 0u; k < 8u; k++) { atomicAdd(&corners[cornersOf[8u * row + k]].curvature, curved); }
        } else {
            let curvature = f32(curved) * unit;
            mean.x = select(curvature, DECAY * mean.x + (1.0 - DECAY) * curvature, mean.x > 0.0);
            let quotient = clamp(f32(asked) * unit / (mean.x + CURVATURE_FLOOR), -1.0, 1.0);
            values[values3] = clamp(values[values3] + view.rates.x * quotient, 0.0, MOST_RAW);
        }
    }
    if weighted > 0 {
        var basis = harmonics(lookAt(brick, place), B);
        var norm = 0.0;
        for (var k = 0; k < B; k++) { norm += ofBand(view.parts, k) * basis.f[k] * basis.f[k]; }
        let weight = f32(weighted) * unit;
        mean.y = select(weight, DECAY * mean.y + (1.0 - DECAY) * weight, mean.y > 0.0);
        let scale = 1.0 / (mean.y + WEIGHT_FLOOR);
        let colour = painted[row].rgb;
        let slope = max(colour * (1.0 - colour), vec3f(SLOPE_FLOOR));
        let moved = vec3f(low.xyz) * (unit * scale * view.rates.y / norm) / slope;
        let held = view.rates.y * weight * scale;
        var own = brick.start + cell;
        for (var k = 0; k < B; k++) {
            let step = ofBand(view.parts, k) * basis.f[k] * moved;
            let kept = 1.0 - ofBand(view.ridge, k) * held;
            var next = own;
            for (var channel = 0; channel < 3; channel++) {
                values[next] = values[next] * kept + step[channel];
                next += u32(B) * brick.count;
            }
            own += brick.count;
        }
    }
    means[row] = mean;
}
