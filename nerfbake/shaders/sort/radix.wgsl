// Sort entries by four bits of their keys; equal ones keep their order. The passes are sortCount, a scan of `places`,
// and sortMove. A workgroup for each block of BLOCK entries. WGSL. Paste job.wgsl above this file.
//
//   extent   uint32; number job.at is how many entries there are. If that is more than job.room, so many are sorted
//   entries  key and value
//   sorted   the same, in their new order
//   places   uint32 for each digit, for each block: how many entries have it; after the scan, where they go
const THREADS = 128u;
const EACH = 16u;
const BLOCK = 2048u;
const DIGITS = 16u;

@group(1) @binding(0) var<storage, read> extent: array<u32>;
@group(1) @binding(1) var<storage, read> entries: array<vec2u>;
@group(1) @binding(2) var<storage, read_write> sorted: array<vec2u>;
@group(1) @binding(3) var<storage, read_write> places: array<u32>;

var<workgroup> tally: array<u32, 2048>;  // for each digit, for each thread

fn digitOf(key: u32) -> u32 {
    return (key >> job.shift) & (DIGITS - 1u);
}

// Count the digits of each thread's entries, which are neighbours.
fn countOwn(block: u32, lane: u32) {
    for (var digit = 0u; digit < DIGITS; digit++) { tally[THREADS * digit + lane] = 0u; }
    let end = min(extent[job.at], job.room);
    let first = BLOCK * block + EACH * lane;
    for (var at = first; at < min(first + EACH, end); at++) { tally[THREADS * digitOf(entries[at].x) + lane] += 1u; }
    workgroupBarrier();
}

@compute @workgroup_size(THREADS)
fn sortCount(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let block = group.y * groups.x + group.x;
    countOwn(block, lane);
    if lane < DIGITS && block < job.blocks {
        var sum = 0u;
        for (var k = 0u; k < THREADS; k++) { sum += tally[THREADS * lane + k]; }
        places[job.blocks * lane + block] = sum;
    }
}

@compute @workgroup_size(THREADS)
fn sortMove(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let block = group.y * groups.x + group.x;
    countOwn(block, lane);
    if lane < DIGITS && block < job.blocks {
        var next = places[job.blocks * lane + block];
        for (var k = 0u; k < THREADS; k++) {
            let own = tally[THREADS * lane + k];
            tally[THREADS * lane + k] = next;
            next += own;
        }
    }
    workgroupBarrier();
    let end = min(extent[job.at], job.room);
    let first = BLOCK * block + EACH * lane;
    for (var at = first; at < min(first + EACH, end); at++) {
        let entry = entries[at];
        let slot = THREADS * digitOf(entry.x) + lane;
        sorted[tally[slot]] = entry;
        tally[slot] += 1u;
    }
}
