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

// a times b, value by value
inline void products(const Sample* a, const Sample* b, int count, Sample* __restrict out) {
    for (int k = 0; k < count; k++) out[k] = mul(a[k], b[k]);
}

inline void turn_by(const Sample* a, int count, Sample* __restrict values) {
    for (int k = 0; k < count; k++) values[k] = mul(values[k], a[k]);
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

// Values of two vectors at fixed places, those of the second one counted on. Each compiler has its own word for it.
#if defined(__clang__)
#define GR_ROS2_MIX(Places, a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define GR_ROS2_MIX(Places, a, b, ...) __builtin_shuffle(a, b, Places{__VA_ARGS__})
#endif

constexpr int kLanes = 8;
using Lanes = float __attribute__((vector_size(kLanes * sizeof(float))));
using Places = int32_t __attribute__((vector_size(kLanes * sizeof(int32_t))));

inline Lanes lanes(const float* from) {
    Lanes values;
    std::memcpy(&values, from, sizeof values);
    return values;
}

inline void put(Lanes values, float* to) { std::memcpy(to, &values, sizeof values); }

// Four samples side by side, real part first.
using Four = Lanes;
using Wholes = int64_t __attribute__((vector_size(4 * sizeof(int64_t))));

inline Four four(const Sample* from) { return lanes(reinterpret_cast<const float*>(from)); }

inline void put(Four values, Sample* to) { put(values, reinterpret_cast<float*>(to)); }

// Real and imaginary parts the other way round.
inline Four swapped(Four a) { return GR_ROS2_MIX(Places, a, a, 1, 0, 3, 2, 5, 4, 7, 6); }

// Four factors as a product needs them: their real parts twice, and their imaginary ones with both signs.
struct Factors {
    Four real, imag;

    Factors() = default;
    Factors(Sample a, Sample b, Sample c, Sample d)
        : real{a.real(), a.real(), b.real(), b.real(), c.real(), c.real(), d.real(), d.real()},
          imag{-a.imag(), a.imag(), -b.imag(), b.imag(), -c.imag(), c.imag(), -d.imag(), d.imag()} {}

    Four times(Four a) const { return a * real + swapped(a) * imag; }
};

// Forward FFT of a power of 2, at least 16 (Stockham, radix 4, one radix 2 where needed).
class Fft {
   public:
    explicit Fft(int size) : size_(size) {
        const auto root = [&](int k) { return unit(-kTau * (k & (size - 1)) / size); };
        for (int k = 0; k < size / 4; k += 4)
            for (int turns = 1; turns < 4; turns++)
                factors_.emplace_back(root(turns * k), root(turns * (k + 1)), root(turns * (k + 2)), root(turns * (k + 3)));
        for (int done = 4; size / done >= 4; done *= 4)
            for (int k = 0; k < size / done / 4; k++)
                for (int turns = 1; turns < 4; turns++) {
                    const Sample one = root(turns * k * done);
                    factors_.emplace_back(one, one, one, one);
                }
    }

    int size() const { return size_; }

    // In place; `spare` has room for as many.
    void run(Sample* __restrict data, Sample* __restrict spare) const {
        if (result(data, spare) != data) std::memcpy(static_cast<void*>(data), spare, sizeof(Sample) * size_);
    }

    // The same, where it comes to lie: one of both.
    const Sample* result(Sample* __restrict data, Sample* __restrict spare) const {
        const Factors* by = first(data, spare);
        Sample *from = spare, *to = data;
        int left = size_ / 4, done = 4;
        for (; left >= 4; left /= 4, done *= 4) {
            by = radix4(from, to, left / 4, done, by);
            std::swap(from, to);
        }
        if (left == 2) {
            for (int k = 0; k < done; k += 4) {
                const Four a = four(from + k), b = four(from + k + done);
                put(a + b, to + k);
                put(a - b, to + k + done);
            }
            std::swap(from, to);
        }
        return from;
    }

   private:
    struct Quad {
        Four one, two, three, four;
    };

    // One step of four values each, with the factors of this place.
    static Quad butterfly(Four a, Four b, Four c, Four d, const Factors* by) {
        constexpr Four kDown = {1, -1, 1, -1, 1, -1, 1, -1};
        const Four sum = a + c, difference = a - c, other = b + d, turned = swapped(b - d) * kDown;
        return {sum + other, by[0].times(difference + turned), by[1].times(sum - other), by[2].times(difference - turned)};
    }

    // The first step, whose results are 4 apart.
    const Factors* first(const Sample* __restrict in, Sample* __restrict out) const {
        const int quarter = size_ / 4;
        const Factors* by = factors_.data();
        for (int k = 0; k < quarter; k += 4, by += 3, in += 4, out += 16) {
            const Quad q = butterfly(four(in), four(in + quarter), four(in + 2 * quarter), four(in + 3 * quarter), by);
            const auto one = reinterpret_cast<Wholes>(q.one), two = reinterpret_cast<Wholes>(q.two);
            const auto three = reinterpret_cast<Wholes>(q.three), four = reinterpret_cast<Wholes>(q.four);
            const Wholes a = GR_ROS2_MIX(Wholes, one, two, 0, 4, 2, 6), b = GR_ROS2_MIX(Wholes, one, two, 1, 5, 3, 7);
            const Wholes c = GR_ROS2_MIX(Wholes, three, four, 0, 4, 2, 6), d = GR_ROS2_MIX(Wholes, three, four, 1, 5, 3, 7);
            put(reinterpret_cast<Four>(GR_ROS2_MIX(Wholes, a, c, 0, 1, 4, 5)), out);
            put(reinterpret_cast<Four>(GR_ROS2_MIX(Wholes, b, d, 0, 1, 4, 5)), out + 4);
            put(reinterpret_cast<Four>(GR_ROS2_MIX(Wholes, a, c, 2, 3, 6, 7)), out + 8);
            put(reinterpret_cast<Four>(GR_ROS2_MIX(Wholes, b, d, 2, 3, 6, 7)), out + 12);
        }
        return by;
    }

    const Factors* radix4(const Sample* __restrict from, Sample* __restrict to, int quarter, int done,
                          const Factors* by) const {
        const int apart = quarter * done;
        for (int j = 0; j < quarter; j++, by += 3, to += 4 * done) {
            for (int k = 0; k < done; k += 4, from += 4) {
                const Quad q = butterfly(four(from), four(from + apart), four(from + 2 * apart), four(from + 3 * apart), by);
                put(q.one, to + k);
                put(q.two, to + k + done);
                put(q.three, to + k + 2 * done);
                put(q.four, to + k + 3 * done);
            }
        }
        return by;
    }

    int size_;
    std::vector<Factors> factors_;  // of each step, three by three
};

}  // namespace gr_ros2
