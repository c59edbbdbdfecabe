// Trilinear reads of a float grid with NanoVDB's own sampler, one thread.
//
//     nanovdb_access GRID.nvdb STENCIL POINTS...     STENCIL 1: with the sampler's stencil cache, 0: without
//
// POINTS are files of 3 x float32 in voxels. Prints the version, then for each file nanoseconds a point (the second of
// two passes) and the sum of what was read and of its absolute values.
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <vector>

#define NANOVDB_USE_INTRINSICS
#include <nanovdb/util/IO.h>
#include <nanovdb/util/SampleFromVoxels.h>

using Points = std::vector<nanovdb::Vec3f>;

template <bool Stencil>
void read(const nanovdb::FloatGrid& grid, const Points& points, std::vector<float>& out)
{
    auto accessor = grid.getAccessor();
    auto sampler = nanovdb::createSampler<1, decltype(accessor), Stencil>(accessor);
    for (size_t i = 0; i < points.size(); ++i) out[i] = sampler(points[i]);
}

int main(int count, char** arguments)
{
    auto handle = nanovdb::io::readGrid(arguments[1]);
    const auto* grid = handle.grid<float>();
    if (!grid) return 1;
    std::printf("%d.%d.%d\n", NANOVDB_MAJOR_VERSION_NUMBER, NANOVDB_MINOR_VERSION_NUMBER, NANOVDB_PATCH_VERSION_NUMBER);
    for (int k = 3; k < count; ++k) {
        std::ifstream file(arguments[k], std::ios::binary | std::ios::ate);
        Points points(size_t(file.tellg()) / sizeof(nanovdb::Vec3f));
        file.seekg(0);
        file.read(reinterpret_cast<char*>(points.data()), points.size() * sizeof(nanovdb::Vec3f));
        std::vector<float> out(points.size());
        double nanoseconds = 0, sum = 0, size = 0;
        for (int pass = 0; pass < 2; ++pass) {
            auto start = std::chrono::steady_clock::now();
            std::atoi(arguments[2]) ? read<true>(*grid, points, out) : read<false>(*grid, points, out);
            nanoseconds = std::chrono::duration<double, std::nano>(std::chrono::steady_clock::now() - start).count();
        }
        for (float value : out) sum += value, size += std::fabs(value);
        std::printf("%.17g %.17g %.17g\n", nanoseconds / points.size(), sum, size);
    }
}
