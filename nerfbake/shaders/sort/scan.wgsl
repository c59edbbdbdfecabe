// Replace numbers by the sums of those before them. The passes are scanParts, scanTotals and scanWhole. WGSL.
// Paste job.wgsl above this file.
//
//   data    uint32: job.count numbers
//   totals  uint32 for each part of PART numbers: its sum; after scanTotals, the sum of the parts before it
const THREADS = 256u;
const EACH = 8u;
const PART = 2048u;

@group(1) @binding(0) var<storage, read_write> data: array<u32>;
@group(1) @binding(1) var<storage, read_write> totals: array<u32>;

var<workgroup> sums: array<u32, THREADS>;

// Return the sum of the values of the threads before this one; sums[THREADS - 1] is then the sum of all.
fn sumBefore(lane: u32, value: u32) -> u32 {
    sums[lane] = value;
    workgroupBarrier();
    for (var reach = 1u; reach < THREADS; reach *= 2u) {
        var other = 0u;
        if lane >= reach { other = sums[lane - reach]; }
        workgroupBarrier();
        sums[lane] += other;
        workgroupBarrier();
    }
    return sums[lane] - value;
}

fn sumOf(first: u32) -> u32 {
    var sum = 0u;
    for (var at = first; at < min(first + EACH, job.count); at++) { sum += data[at]; }
    return sum;
}

@compute @workgroup_size(THREADS)
fn scanParts(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let part = group.y * groups.x + group.x;
    _ = sumBefore(lane, sumOf(PART * part + EACH * lane));
    if lane == 0u && PART * part < job.count { totals[part] = sums[THREADS - 1u]; }
}

@compute @workgroup_size(THREADS)
fn scanTotals(@builtin(local_invocation_index) lane: u32) {
    let parts = (job.count + PART - 1u) / PART;
    var carried = 0u;
    for (var first = 0u; first < parts; first += THREADS) {
        let at = first + lane;
        var value = 0u;
        if at < parts { value = totals[at]; }
        let before = sumBefore(lane, value);
        if at < parts { totals[at] = carried + before; }
        carried += sums[THREADS - 1u];
        workgroupBarrier();
    }
}

@compute @workgroup_size(THREADS)
fn scanWhole(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let part = group.y * groups.x + group.x;
    let first = PART * part + EACH * lane;
    var sum = sumBefore(lane, sumOf(first));
    if first < job.count { sum += totals[part]; }
    for (var at = first; at < min(first + EACH, job.count); at++) {
        let own = data[at];
        data[at] = sum;
        sum += own;
    }
}
