// Read the grids of a .nvdb with NVIDIA's own PNanoVDB.h, in C and in HLSL: nearest and trilinear lookups in Float,
// Fp16 and OnIndex grids. The values of an OnIndex grid come from the table, float32 or float16, that nerfbake stores
// as its blind data.
//
// This file includes PNanoVDB.h, which must be in the include path. Debian's libnanovdb-dev, NVIDIA's Warp and OpenVDB
// contain it. OnIndex grids need version 32.6 or later. A C compiler reads PNanoVDB.h as C, any other compiler as HLSL,
// unless you define PNANOVDB_C or PNANOVDB_HLSL first.
//
//   buf  the grid's bytes, from its magic on, as uint32. In a file without codec (`--codec none`) they follow the 192
//        bytes of header and the grid's name with a NUL. HLSL: a StructuredBuffer<uint>
//
// Points are in voxels whose CENTRES are at integers. In a shader, first define NANOVDB_TYPE as
// PNANOVDB_GRID_TYPE_FLOAT, _FP16 or _ONINDEX: if the type is known only at run time, Mesa's compiler takes minutes and
// gigabytes.
#ifndef NERFBAKE_NANOVDB_H
#define NERFBAKE_NANOVDB_H
#if !defined(PNANOVDB_C) && !defined(PNANOVDB_HLSL)
#if defined(__STDC__) || defined(__cplusplus)
#define PNANOVDB_C
#else
#define PNANOVDB_HLSL
#endif
#endif
#include "PNanoVDB.h"

struct nanovdb_grid_t {
    pnanovdb_grid_type_t type;
    pnanovdb_root_handle_t root;
    pnanovdb_address_t table;    // of OnIndex grids
    pnanovdb_uint32_t halves;    // 1: the table is float16
    pnanovdb_uint32_t channels;  // values per row of the table
};
PNANOVDB_STRUCT_TYPEDEF(nanovdb_grid_t)

// channels: values per row of an OnIndex grid's table, as `nerfbake info` prints them; 1 for other grids.
PNANOVDB_FORCE_INLINE nanovdb_grid_t nanovdb_open(pnanovdb_buf_t buf, pnanovdb_uint32_t channels) {
    pnanovdb_grid_handle_t handle;
    handle.address = pnanovdb_address_null();
    nanovdb_grid_t grid;
#if defined(NANOVDB_TYPE)
    grid.type = NANOVDB_TYPE;
#else
    grid.type = pnanovdb_grid_get_grid_type(buf, handle);
#endif
    grid.root = pnanovdb_tree_get_root(buf, pnanovdb_grid_get_tree(buf, handle));
    grid.table = pnanovdb_address_null();
    grid.halves = 0u;
    grid.channels = channels;
#if defined(PNANOVDB_GRID_TYPE_ONINDEX)
    if (grid.type == PNANOVDB_GRID_TYPE_ONINDEX) {
        pnanovdb_gridblindmetadata_handle_t blind = pnanovdb_grid_get_gridblindmetadata(buf, handle, 0u);
        grid.table = pnanovdb_grid_get_gridblindmetadata_value_address(buf, handle, 0u);
        grid.halves = pnanovdb_gridblindmetadata_get_value_size(buf, blind) == 2u ? 1u : 0u;
    }
#endif
    return grid;
}

#if defined(PNANOVDB_GRID_TYPE_ONINDEX)
// Entry i of the table.
PNANOVDB_FORCE_INLINE float nanovdb_entry(pnanovdb_buf_t buf, nanovdb_grid_t grid, pnanovdb_uint32_t i) {
    if (grid.halves == 0u) return pnanovdb_read_float(buf, pnanovdb_address_offset_product(grid.table, 4u, i));
#if defined(PNANOVDB_HLSL)
    return pnanovdb_read_half(buf, pnanovdb_address_offset_product(grid.table, 2u, i));
#else
    // In C, PNanoVDB returns the bits of a half. Shift them to a float's exponent and mantissa, and multiply by 2^112.
    pnanovdb_uint32_t bits = pnanovdb_read_uint16(buf, pnanovdb_address_offset_product(grid.table, 2u, i));
    float size = pnanovdb_uint32_as_float((bits & 0x7FFFu) << 13u) * pnanovdb_uint32_as_float(0x77800000u);
    return (bits & 0x8000u) != 0u ? -size : size;
#endif
}
#endif

// Value k of a voxel; k is 0 for grids with one channel.
PNANOVDB_FORCE_INLINE float nanovdb_value(
    pnanovdb_buf_t buf, nanovdb_grid_t grid, pnanovdb_coord_t voxel, pnanovdb_uint32_t k
) {
    pnanovdb_uint32_t level = 0u;
    pnanovdb_address_t place = pnanovdb_root_get_value_address_and_level(
        grid.type, buf, grid.root, PNANOVDB_REF(voxel), PNANOVDB_REF(level)
    );
#if defined(PNANOVDB_GRID_TYPE_ONINDEX)
    if (grid.type == PNANOVDB_GRID_TYPE_ONINDEX) {
        pnanovdb_uint64_t row = pnanovdb_root_onindex_get_value_index(buf, place, PNANOVDB_REF(voxel), level);
        return nanovdb_entry(buf, grid, pnanovdb_uint64_low(row) * grid.channels + k);
    }
#endif
    if (grid.type == PNANOVDB_GRID_TYPE_FP16) {
        return pnanovdb_root_fp16_read_float(buf, place, PNANOVDB_REF(voxel), level);
    }
    return pnanovdb_read_float(buf, place);
}

// Clamp a coordinate to 1e9, because an int32 ends at 2^31.
PNANOVDB_FORCE_INLINE float nanovdb_bounded(float v) {
    return v > -1e9f ? (v < 1e9f ? v : 1e9f) : -1e9f;
}

// Value k of the voxel that contains a point.
PNANOVDB_FORCE_INLINE float nanovdb_nearest(
    pnanovdb_buf_t buf, nanovdb_grid_t grid, float px, float py, float pz, pnanovdb_uint32_t k
) {
    float x = nanovdb_bounded(px), y = nanovdb_bounded(py), z = nanovdb_bounded(pz);
    float lx = pnanovdb_floor(x), ly = pnanovdb_floor(y), lz = pnanovdb_floor(z);
    pnanovdb_coord_t voxel;
    voxel.x = pnanovdb_float_to_int32(lx) + (x - lx >= 0.5f ? 1 : 0);
    voxel.y = pnanovdb_float_to_int32(ly) + (y - ly >= 0.5f ? 1 : 0);
    voxel.z = pnanovdb_float_to_int32(lz) + (z - lz >= 0.5f ? 1 : 0);
    return nanovdb_value(buf, grid, voxel, k);
}

// Value k at a point, interpolated between the eight voxels whose centres surround it.
PNANOVDB_FORCE_INLINE float nanovdb_trilinear(
    pnanovdb_buf_t buf, nanovdb_grid_t grid, float px, float py, float pz, pnanovdb_uint32_t k
) {
    float x = nanovdb_bounded(px), y = nanovdb_bounded(py), z = nanovdb_bounded(pz);
    float lx = pnanovdb_floor(x), ly = pnanovdb_floor(y), lz = pnanovdb_floor(z), sum = 0.0f;
    for (pnanovdb_int32_t i = 0; i < 8; i++) {
        pnanovdb_int32_t a = i >> 2, b = i >> 1 & 1, c = i & 1;
        float weight = (a == 1 ? x - lx : 1.0f - (x - lx)) * (b == 1 ? y - ly : 1.0f - (y - ly));
        weight *= c == 1 ? z - lz : 1.0f - (z - lz);
        pnanovdb_coord_t voxel;
        voxel.x = pnanovdb_float_to_int32(lx) + a;
        voxel.y = pnanovdb_float_to_int32(ly) + b;
        voxel.z = pnanovdb_float_to_int32(lz) + c;
        sum += weight * nanovdb_value(buf, grid, voxel, k);
    }
    return sum;
}
#endif  // NERFBAKE_NANOVDB_H
