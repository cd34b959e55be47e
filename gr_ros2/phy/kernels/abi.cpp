// The C interface of the kernels, for ctypes.
//
// Invariants: no exception leaves a function; arrays belong to the caller; a call takes no lock and keeps no argument.

#include <cstddef>
#include <exception>

#include "codes.h"
#include "stream.h"

#define GR_ROS2_API extern "C" __attribute__((visibility("default")))

using namespace gr_ros2;

namespace {

enum Kind { kOfdm, kLinear, kLora };

// A call that could not get memory says so by this.
constexpr int64_t kNoMemory = std::numeric_limits<int64_t>::max();

template <typename Parameters>
Modem* made(std::unique_ptr<Modem> (*make)(const Parameters&), const void* given, int64_t size) {
    if (size != static_cast<int64_t>(sizeof(Parameters))) return nullptr;
    return make(*static_cast<const Parameters*>(given)).release();
}

Samples view(const void* samples, int64_t count) { return {static_cast<const Sample*>(samples), count}; }

}  // namespace

// Version of this interface and of the parameters in `modem.h`. Increase it with each change, here and in
// `kernels/library.py`.
GR_ROS2_API int kernels_version() { return 8; }

// What it was compiled for.
GR_ROS2_API const char* kernels_target() {
#if defined(__AVX2__) && defined(__FMA__)
    return "AVX2";
#elif defined(__ARM_NEON)
    return "NEON";
#elif defined(__SSE2__)
    return "SSE2";
#else
    return "plain";
#endif
}

// Whether this processor runs what was compiled for AVX2. Asked of the library that runs everywhere.
GR_ROS2_API int kernels_has_avx2() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
    return 0;
#endif
}

// A modem from its parameters (`size` bytes of them); null where they are not those of this library, or without memory.
GR_ROS2_API void* modem_new(int kind, const void* parameters, int64_t size) {
    try {
        switch (kind) {
            case kOfdm: return made(make_ofdm, parameters, size);
            case kLinear: return made(make_linear, parameters, size);
            case kLora: return made(make_lora, parameters, size);
        }
    } catch (const std::exception&) {
    }
    return nullptr;
}

GR_ROS2_API void modem_free(void* modem) { delete static_cast<Modem*>(modem); }

// Samples searched; `start` becomes that of a burst, or the lowest number there is.
GR_ROS2_API int64_t modem_find(const void* modem, const void* samples, int64_t count, int64_t* start) {
    try {
        const Search found = static_cast<const Modem*>(modem)->find(view(samples, count));
        *start = found.start;
        return found.searched;
    } catch (const std::exception&) {
        return kNoMemory;
    }
}

// A `Result`, or -1 without memory.
GR_ROS2_API int modem_read(const void* modem, const void* samples, int64_t count, int64_t start, float* soft, void* points,
                           void* report) {
    try {
        return static_cast<const Modem*>(modem)->read(view(samples, count), start, soft, static_cast<Sample*>(points),
                                                      static_cast<Report*>(report));
    } catch (const std::exception&) {
        return -1;
    }
}

// A value of `Taken`, or -1 without memory. `stream` is what stream.h says.
GR_ROS2_API int modem_take(const void* modem, void* stream) {
    try {
        return static_cast<int>(take(*static_cast<const Modem*>(modem), *static_cast<Stream*>(stream)));
    } catch (const std::exception&) {
        return -1;
    }
}

// 1, or -1 without memory. `batch` is what stream.h says.
GR_ROS2_API int modem_modulate(const void* modem, const void* batch) {
    try {
        modulate(*static_cast<const Modem*>(modem), *static_cast<const Batch*>(batch));
        return 1;
    } catch (const std::exception&) {
        return -1;
    }
}

// The decoders of codes.h: 1, or -1 without memory.
GR_ROS2_API int decode_convolutional(const uint8_t* levels, int64_t bits, const int32_t* polynomials, uint8_t* out) {
    try {
        Viterbi::decode(levels, bits, polynomials, out);
        return 1;
    } catch (const std::exception&) {
        return -1;
    }
}

GR_ROS2_API int decode_ldpc(const void* checks, const float* soft, uint8_t* out) {
    try {
        decode_ldpc(*static_cast<const Checks*>(checks), soft, out);
        return 1;
    } catch (const std::exception&) {
        return -1;
    }
}

GR_ROS2_API int decode_polar(int32_t size, const float* soft, const uint8_t* frozen, uint8_t* out) {
    try {
        Polar::decode(size, soft, frozen, out);
        return 1;
    } catch (const std::exception&) {
        return -1;
    }
}
