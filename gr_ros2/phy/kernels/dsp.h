// What the kernels share: complex arithmetic, FFT, peaks. Single precision, as the samples are.
//
// Invariants: no floating-point flag of the process is touched; a NaN goes through every function here without undefined
// behaviour, and where numpy's argmax would stop at it, so does ours.

#pragma once

#include <algorithm>
#include <cmath>
#include <complex>
#include <cstdint>
#include <cstring>
#include <vector>

namespace gr_ros2 {

using Sample = std::complex<float>;
using Turn = std::complex<double>;

constexpr double kTau = 6.283185307179586476925287;
constexpr float kLowest = -1e30f;  // below every likelihood

// std::complex's own product looks for infinities, which costs more than the product.
template <typename T>
inline std::complex<T> mul(std::complex<T> a, std::complex<T> b) {
    return {a.real() * b.real() - a.imag() * b.imag(), a.real() * b.imag() + a.imag() * b.real()};
}

// a times the conjugate of b
template <typename T>
inline std::complex<T> mul_conj(std::complex<T> a, std::complex<T> b) {
    return {a.real() * b.real() + a.imag() * b.imag(), a.imag() * b.real() - a.real() * b.imag()};
}

inline float square(Sample a) { return a.real() * a.real() + a.imag() * a.imag(); }

inline Turn turn(double angle) { return {std::cos(angle), std::sin(angle)}; }

inline Sample unit(double angle) { return Sample(turn(angle)); }

// exp(i (start + step k)) for k = 0, 1, ...: by four recurrences, which do not wait for each other.
class Rotation {
   public:
    Rotation(double start, double step) {
        const Turn one = turn(step), two = mul(one, one);
        four_ = mul(two, two);
        next_[0] = turn(start);
        next_[1] = mul(next_[0], one);
        next_[2] = mul(next_[0], two);
        next_[3] = mul(next_[1], two);
    }

    void fill(Sample* out, int64_t count) {
        int64_t k = 0;
        for (; k + 4 <= count; k += 4) {
            for (int j = 0; j < 4; j++) {
                out[k + j] = Sample(next_[j]);
                next_[j] = mul(next_[j], four_);
            }
        }
        for (int j = 0; j < 4 && k < count; k++, j++) out[k] = Sample(next_[j]);
    }

   private:
    Turn four_, next_[4];
};

// The largest value; what comes out where there is a NaN is not said.
inline float largest(const float* values, int count) {
    constexpr int lanes = 16;
    float most[lanes];
    int k = 0;
    for (int lane = 0; lane < lanes; lane++) most[lane] = values[0];
    for (; k + lanes <= count; k += lanes) {
        for (int lane = 0; lane < lanes; lane++)
            most[lane] = values[k + lane] > most[lane] ? values[k + lane] : most[lane];
    }
    float top = values[0];
    for (int lane = 0; lane < lanes; lane++) top = most[lane] > top ? most[lane] : top;
    for (; k < count; k++) top = values[k] > top ? values[k] : top;
    return top;
}

// Index of the largest value; of the first NaN where there is one.
inline int argmax(const float* values, int count) {
    float sum = 0;
    for (int k = 0; k < count; k++) sum += values[k];
    int best = 0;
    if (sum == sum) {
        const float top = largest(values, count);
        while (best + 1 < count && values[best] != top) best++;
        return best;
    }
    for (int k = 1; k < count && values[best] == values[best]; k++) {
        if (!(values[k] <= values[best])) best = k;
    }
    return best;
}

// Squared magnitudes.
inline void squares(const Sample* values, int count, float* out) {
    for (int k = 0; k < count; k++) out[k] = square(values[k]);
}

// Where the parabola through three neighbours is highest, -0.5..0.5 from the middle one.
inline double parabola_peak(double before, double at, double after) {
    const double bend = before - 2 * at + after;
    return bend < 0 ? std::max(-0.5, std::min(0.5, 0.5 * (before - after) / bend)) : 0.0;
}

// a modulo n, 0..n
inline double wrapped(double a, double n) {
    const double rest = std::fmod(a, n);
    return rest < 0 ? rest + n : rest;
}

// Forward FFT of a power of 2 (Stockham, radix 4, one radix 2 where needed).
class Fft {
   public:
    explicit Fft(int size) : size_(size), twiddles_(size) {
        for (int k = 0; k < size; k++) twiddles_[k] = unit(-kTau * k / size);
        for (int turns = 1; turns < 4; turns++)
            for (int k = 0; k < size / 4; k++) first_[turns - 1].push_back(twiddles_[turns * k & (size - 1)]);
    }

    int size() const { return size_; }

    // In place; `spare` has room for as many.
    void run(Sample* __restrict data, Sample* __restrict spare) const {
        Sample *from = data, *to = spare;
        int left = size_, done = 1;
        if (left >= 4) {
            first(data, spare);
            left /= 4;
            done = 4;
        }
        for (; left >= 4; left /= 4, done *= 4) {
            radix4(from, to, left / 4, done);
            std::swap(from, to);
        }
        if (left == 2) {
            for (int k = 0; k < done; k++) {
                const Sample a = from[k], b = from[k + done];
                to[k] = a + b;
                to[k + done] = a - b;
            }
            std::swap(from, to);
        }
        if (from != data) std::memcpy(static_cast<void*>(data), from, sizeof(Sample) * size_);
    }

   private:
    // The first step, whose results are 4 apart: they are made side by side, and put there.
    void first(Sample* __restrict data, Sample* __restrict spare) const {
        const int quarter = size_ / 4;
        const Sample *a = data, *b = a + quarter, *c = b + quarter, *d = c + quarter;
        const Sample *w1 = first_[0].data(), *w2 = first_[1].data(), *w3 = first_[2].data();
        Sample *one = spare, *two = one + quarter, *three = two + quarter, *four = three + quarter;
        for (int k = 0; k < quarter; k++) {
            const Sample sum = a[k] + c[k], difference = a[k] - c[k], other = b[k] + d[k], rest = b[k] - d[k];
            const Sample turned(rest.imag(), -rest.real());
            one[k] = sum + other;
            two[k] = mul(w1[k], difference + turned);
            three[k] = mul(w2[k], sum - other);
            four[k] = mul(w3[k], difference - turned);
        }
        for (int k = 0; k < quarter; k++) {
            data[4 * k] = one[k];
            data[4 * k + 1] = two[k];
            data[4 * k + 2] = three[k];
            data[4 * k + 3] = four[k];
        }
    }

    void radix4(const Sample* __restrict from, Sample* __restrict to, int quarter, int done) const {
        const int mask = size_ - 1;
        for (int j = 0; j < quarter; j++) {
            const Sample w1 = twiddles_[j * done], w2 = twiddles_[2 * j * done & mask], w3 = twiddles_[3 * j * done & mask];
            const Sample* in = from + j * done;
            Sample* out = to + 4 * j * done;
            for (int k = 0; k < done; k++) {
                const Sample a = in[k], b = in[k + quarter * done], c = in[k + 2 * quarter * done],
                             d = in[k + 3 * quarter * done];
                const Sample sum = a + c, difference = a - c, other = b + d, turned((b - d).imag(), -(b - d).real());
                out[k] = sum + other;
                out[k + done] = mul(w1, difference + turned);
                out[k + 2 * done] = mul(w2, sum - other);
                out[k + 3 * done] = mul(w3, difference - turned);
            }
        }
    }

    int size_;
    std::vector<Sample> twiddles_, first_[3];  // of the first step: once, twice and three times the angle
};

}  // namespace gr_ros2
