// The record of a pass of a scan or a sort. WGSL.
struct Job {
    count: u32,   // numbers to scan
    shift: u32,   // the lowest of the four bits to sort by
    blocks: u32,  // of entries to sort
    at: u32,      // where in `extent` the number of entries is
    room: u32,    // of the buffers of entries
}

@group(0) @binding(0) var<uniform> job: Job;
