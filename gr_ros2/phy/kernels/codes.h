// Decoders of the codes in gr_ros2/phy/fec.py, which has the meaning of their parameters.
//
// Invariant: whatever the soft bits, NaN included, only the given arrays are read and written.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace gr_ros2 {

// The Viterbi algorithm for constraint length 7 and rate 1/2, from state 0 to state 0. Both polynomials contain the newest
// and the oldest bit, so the two branches into a state have complementary bits.
class Viterbi {
   public:
    // `levels`: two bytes for each of the bits and the six zeros behind them, 255 for a certain 1.
    static void decode(const uint8_t* levels, int64_t bits, const int32_t* polynomials, uint8_t* out) {
        static thread_local std::vector<uint8_t> decisions;
        const int64_t steps = bits + kMemory;
        decisions.resize(static_cast<size_t>(steps) * kStates);
        int32_t expected[2][kHalf], costs[2][kStates];
        for (int word = 0; word < 2; word++)
            for (int k = 0; k < kHalf; k++) expected[word][k] = odd(2 * k & polynomials[word]) ? 255 : 0;
        std::fill_n(costs[0], kStates, kFar);
        costs[0][0] = 0;
        for (int64_t step = 0; step < steps; step++) {
            const int32_t *before = costs[step & 1], first = levels[2 * step], second = levels[2 * step + 1];
            int32_t* after = costs[~step & 1];
            uint8_t* chosen = &decisions[static_cast<size_t>(step) * kStates];
            for (int k = 0; k < kHalf; k++) {
                // As many bits as GNU Radio's decoder has.
                const int32_t cost = ((first ^ expected[0][k]) + (second ^ expected[1][k]) + 1) >> 3, other = kMost - cost;
                const int32_t zero_low = before[k] + cost, zero_high = before[k + kHalf] + other;
                const int32_t one_low = before[k] + other, one_high = before[k + kHalf] + cost;
                after[2 * k] = std::min(zero_low, zero_high);
                after[2 * k + 1] = std::min(one_low, one_high);
                chosen[2 * k] = zero_high <= zero_low;
                chosen[2 * k + 1] = one_high <= one_low;
            }
        }
        int state = 0;
        for (int64_t step = steps - 1; step >= 0; step--) {
            if (step < bits) out[step] = state & 1;
            state = state >> 1 | decisions[static_cast<size_t>(step) * kStates + state] << (kMemory - 1);
        }
    }

   private:
    static constexpr int kMemory = 6, kStates = 1 << kMemory, kHalf = kStates / 2, kMost = 63;
    static constexpr int32_t kFar = 1 << 20;

    static bool odd(int value) {
        bool one = false;
        for (; value; value &= value - 1) one = !one;
        return one;
    }
};

constexpr double kCertain = 1 - 1e-12;

// A parity-check matrix: the bits of each check, and the places of each bit among them.
struct Checks {
    int32_t bit_count, check_count, rounds;
    const int32_t *check_begins, *bits;    // `bits` of check k: from check_begins[k] to check_begins[k + 1]
    const int32_t *bit_begins, *places;    // places in `bits` of bit k: from bit_begins[k] to bit_begins[k + 1]
};

// The sum-product algorithm, until all checks hold or there were enough rounds. Ratios are those of a 1 to a 0.
inline void decode_ldpc(const Checks& given, const float* soft, uint8_t* out) {
    static thread_local std::vector<double> ratios, to_bits, to_checks;
    const int edges = given.check_begins[given.check_count];
    ratios.resize(given.bit_count);
    to_bits.assign(edges, 1.0);
    to_checks.resize(edges);
    for (int bit = 0; bit < given.bit_count; bit++) ratios[bit] = std::exp(static_cast<double>(soft[bit]));
    for (int round = 0;; round++) {
        for (int bit = 0; bit < given.bit_count; bit++) {
            double all = ratios[bit];
            for (int k = given.bit_begins[bit]; k < given.bit_begins[bit + 1]; k++) all *= to_bits[given.places[k]];
            out[bit] = all > 1;
            for (int k = given.bit_begins[bit]; k < given.bit_begins[bit + 1]; k++)
                to_checks[given.places[k]] = all / to_bits[given.places[k]];
        }
        bool good = true;
        for (int check = 0; check < given.check_count && good; check++) {
            int sum = 0;
            for (int k = given.check_begins[check]; k < given.check_begins[check + 1]; k++) sum ^= out[given.bits[k]];
            good = !sum;
        }
        if (good || round == given.rounds) return;
        for (int check = 0; check < given.check_count; check++) {
            const int first = given.check_begins[check], last = given.check_begins[check + 1];
            // P(0) - P(1) of each bit; that of their sum is the product.
            for (int k = first; k < last; k++) to_checks[k] = (1 - to_checks[k]) / (1 + to_checks[k]);
            for (int k = first; k < last; k++) {
                double others = 1;
                for (int j = first; j < last; j++) others *= j == k ? 1 : to_checks[j];
                others = std::max(-kCertain, std::min(kCertain, others));
                to_bits[k] = (1 - others) / (1 + others);
            }
        }
    }
}

// Successive cancellation for a polar code of `size` bits, in the order in which its transform is made in place.
class Polar {
   public:
    // `soft`: above 0 for a 1; `frozen`: 1 for each bit that is known to be 0; `out`: all bits before the transform.
    static void decode(int size, const float* soft, const uint8_t* frozen, uint8_t* out) {
        static thread_local std::vector<float> ratios;
        static thread_local std::vector<uint8_t> sums;
        ratios.resize(2 * static_cast<size_t>(size));
        sums.resize(size);
        for (int k = 0; k < size; k++) ratios[size + k] = -soft[k];
        decide(size, ratios.data(), frozen, out, sums.data());
    }

   private:
    // The likelihood ratios of `size` bits stand in `ratios` from `size` on, those of the stages before it in front.
    static void decide(int size, float* ratios, const uint8_t* frozen, uint8_t* out, uint8_t* sums) {
        const float* given = ratios + size;
        if (size == 1) {
            *out = *sums = !*frozen && !(*given >= 0);
            return;
        }
        const int half = size / 2;
        float* next = ratios + half;
        for (int k = 0; k < half; k++) {
            const float a = given[k], b = given[k + half], least = std::min(std::abs(a), std::abs(b));
            next[k] = (a < 0) != (b < 0) ? -least : least;
        }
        decide(half, ratios, frozen, out, sums);
        for (int k = 0; k < half; k++) next[k] = sums[k] ? given[k + half] - given[k] : given[k + half] + given[k];
        decide(half, ratios, frozen + half, out + half, sums + half);
        for (int k = 0; k < half; k++) sums[k] ^= sums[k + half];
    }
};

}  // namespace gr_ros2
