// What a kernel is: a burst modem's search and reading (gr_ros2/phy/burst.py has the meaning of each).
//
// Invariants: a modem never changes once it is made, so that any number of threads may use it; what a call works in belongs to
// its thread; samples outside of those given are never looked at, whatever the start.

#pragma once

#include <cstdint>
#include <limits>
#include <memory>

#include "dsp.h"

namespace gr_ros2 {

struct Samples {
    const Sample* at;
    int64_t count;
};

constexpr int64_t kNone = std::numeric_limits<int64_t>::min();

struct Search {
    int64_t searched;
    int64_t start;  // kNone: no burst (yet)
};

class Modem {
   public:
    virtual ~Modem() = default;

    virtual Search find(Samples samples) const = 0;

    // Index behind the last sample that `read` needs.
    virtual int64_t end(Samples samples, int64_t start) const = 0;

    // Soft bits, points and SNR of a burst; false where there is none after all.
    virtual bool read(Samples samples, int64_t start, float* soft, Sample* points, double* snr) const = 0;

    // The samples of a burst, from the bits of a frame; false where numpy does it as well.
    virtual bool modulate(const uint8_t* bits, Sample* out) const {
        (void)bits, (void)out;
        return false;
    }
};

// In each, numbers come before arrays, and `kernels/modem.py` has the same fields in the same order.

struct OfdmParameters {
    int32_t size, prefix, symbols, repeat, frame_bits, degrees, chunk, carrier_count, data_count, pilot_count, once_count,
        twice_count, shift_count, point_count, point_bits;
    double level, alike, energy, power, pair_weight, word_weight_sum, pace_gain, memory, reach, doubt;
    const int32_t *carriers, *data, *pilots, *once, *twice, *shifts;
    const Sample *words, *known, *turns, *whole, *smooth, *smooth_words, *crosswise, *header, *points;
    const float* word_weight;
    const uint8_t* marks;
};

struct LinearParameters {
    int32_t sps, order, point_bits, payload, preamble, chunk, block, rise, edge, slack, unknowns, differential, last_one;
    double turn, clean_energy, threshold, alike;
    const float* steps;
    const Sample *known, *explained, *points;
    const uint8_t* marks;
};

struct LoraParameters {
    int32_t chips, spreading_factor, code_bits, symbols, step, look, head, sync, down, fine, sinc;
    double median_share, limit, threshold, gain, pace_gain, certain;
    const Sample *down_chirp, *up_chirp, *tapered;
    const int32_t* words;
};

std::unique_ptr<Modem> make_ofdm(const OfdmParameters& given);
std::unique_ptr<Modem> make_linear(const LinearParameters& given);
std::unique_ptr<Modem> make_lora(const LoraParameters& given);

}  // namespace gr_ros2
