// What a kernel is: a burst modem's search and reading (gr_ros2/phy/burst.py has the meaning of each).
//
// Invariants: a modem never changes after it is made, so any number of threads may use it; the working memory of a call
// belongs to its thread; only the given samples are read, whatever the start.

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

// Values of a burst in addition to its bits.
struct Report {
    double snr;
    int64_t end;           // index after the last sample that is needed
    int64_t length;        // bytes of the packet
    int64_t soft, points;  // number of soft bits and of points
    int64_t mcs;          // with an adaptive rate, what it was sent with
};

// What reading gave: no burst; its bits; or, where the samples end before the burst does, `snr`, `end`, `length` and
// `mcs` of the report only.
enum Result { kNoBurst, kRead, kCut };

// The allowed packet lengths, `shortest` to `longest` bytes, and the bits sent for each. If there is only one length,
// a burst does not carry it.
class Lengths {
   public:
    Lengths(int32_t shortest, int32_t longest, const int32_t* bits)
        : shortest_(shortest), bits_(bits, bits + (longest - shortest + 1)) {}

    bool fixed() const { return bits_.size() == 1; }
    int count() const { return static_cast<int>(bits_.size()); }
    int longest() const { return shortest_ + count() - 1; }
    int shortest() const { return shortest_; }
    int row(int length) const { return length - shortest_; }
    int bits(int length) const { return bits_[row(length)]; }

   private:
    int32_t shortest_;
    std::vector<int32_t> bits_;
};

constexpr int kWordBits = 32;

// The row of signs with the highest correlation with the soft bits of a word: gr_ros2/phy/length_word.py.
inline int likeliest_word(const float* signs, int count, const float* soft) {
    int best = 0;
    float most = 0;
    for (int row = 0; row < count; row++, signs += kWordBits) {
        float sum = 0;
        for (int bit = 0; bit < kWordBits; bit++) sum += signs[bit] * soft[bit];
        if (row == 0 || sum > most) {
            most = sum;
            best = row;
        }
    }
    return best;
}

class Modem {
   public:
    virtual ~Modem() = default;

    virtual Search find(Samples samples) const = 0;

    // Soft bits, points and other values of a burst.
    virtual Result read(Samples samples, int64_t start, float* soft, Sample* points, Report* report) const = 0;

    // The samples of the burst of a packet of `length` bytes, from the bits of its frame.
    virtual void modulate(const uint8_t* bits, int32_t length, Sample* out) const = 0;
};

// In each, numbers come before arrays, and `kernels/modem.py` has the same fields in the same order.

struct OfdmParameters {
    int32_t shortest, longest;
    int32_t mcs_count, counted, size, prefix, repeat, degrees, chunk, carrier_count, data_count, pilot_count,
        once_count, twice_count, shift_count, even_count, delay_count, weight_count, fractions;
    double level, alike, together, energy, power, pair_weight, word_weight_sum, clocks, unsteady, memory, reach, doubt,
        sure, delay_step;
    const int32_t *frame_bits, *point_counts, *point_bits, *carriers, *data, *pilots, *once, *twice, *shifts;
    const Sample *words, *known, *turns, *whole, *smooth, *smooth_words, *crosswise, *points,
        *advances;
    const float *word_weight, *delays, *weights;
    const uint8_t *marks, *headers, *header_mask;
};

struct LinearParameters {
    int32_t shortest, longest;
    int32_t sps, order, point_bits, preamble, chunk, block, rise, edge, slack, unknowns, differential, last_one,
        pulse_len, lead_len, tail_len;
    double turn, clean_energy, threshold, alike;
    const int32_t* frame_bits;
    const float *signs, *steps, *pulse;
    const Sample *known, *explained, *points, *waves;
    const uint8_t *marks, *lead, *tail;
};

struct LoraParameters {
    int32_t shortest, longest;
    int32_t before, chips, spreading_factor, code_bits, step, look, head, sync, down, fine, sinc;
    double median_share, limit, threshold, gain, pace_gain, certain;
    const int32_t *frame_bits, *telling, *words, *sync_word;
    const Sample *down_chirp, *up_chirp, *tapered;
};

std::unique_ptr<Modem> make_ofdm(const OfdmParameters& given);
std::unique_ptr<Modem> make_linear(const LinearParameters& given);
std::unique_ptr<Modem> make_lora(const LoraParameters& given);

}  // namespace gr_ros2
