// A step of the raw density of each corner by its sums, which are cleared. A thread for each corner. WGSL.
// Paste view.wgsl above this file.
const DECAY = 0.9;
const CURVATURE_FLOOR = 1e-3;
const LEAST_RAW = -4.0;
const MOST_RAW = 12.0;

struct Corner {
    raw: f32,
    mean: f32,
    asked: i32,
    curvature: i32,
}

@group(1) @binding(10) var<storage, read_write> corners: array<Corner>;

@compute @workgroup_size(64)
fn stepCorners(@builtin(global_invocation_id) id: vec3u, @builtin(num_workgroups) groups: vec3u) {
    let number = threadOf(id, groups);
    if number >= arrayLength(&corners) { return; }
    var own = corners[number];
    if own.curvature > 0 {
        let unit = view.limits.w * view.rates.w;
        let curvature = f32(own.curvature) * unit / 8.0;
        own.mean = select(curvature, DECAY * own.mean + (1.0 - DECAY) * curvature, own.mean > 0.0);
        let quotient = clamp(f32(own.asked) * unit / (own.mean + CURVATURE_FLOOR), -1.0, 1.0);
        own.raw = clamp(own.raw + view.rates.z * quotient, LEAST_RAW, MOST_RAW);
    }
    own.asked = 0;
    own.curvature = 0;
    corners[number] = own;
}
