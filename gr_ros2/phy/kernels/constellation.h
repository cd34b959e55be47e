// What received points say of the bits that were sent: gr_ros2/phy/soft.py.
//
// Square constellations are read one axis at a time, since the likelihood of a point is the product of those of its parts.

#pragma once

#include <vector>

#include "dsp.h"

namespace gr_ros2 {

// e^x for x <= 0, relative error 2e-6; 0 below -60, and for a NaN.
inline float exp_below_0(float x) {
    x = x > -60.0f ? x : -60.0f;
    const float power = x * 1.442695041f;
    int32_t whole = static_cast<int32_t>(power);
    whole -= static_cast<float>(whole) > power;
    const float r = power - static_cast<float>(whole);
    const float part =
        1.0f +
        r * (0.693147180f + r * (0.240226507f + r * (0.0555041087f + r * (0.00961812911f + r * 0.00133335581f))));
    const int32_t exponent = (whole + 127) << 23;
    float scale;
    std::memcpy(&scale, &exponent, sizeof scale);
    return part * scale;
}

// What a constellation made of received points. Both axes apart where it is square, real parts only for two points.
struct Received {
    std::vector<float> parts[2];     // real, imaginary
    std::vector<float> sharpness;    // 1 / noise
    std::vector<float> means[2];     // of what was sent, per part
    std::vector<float> squares[2];   // and of its square
    std::vector<float> bits[3];      // soft, of one axis
    std::vector<float> likely;       // of every point, where axes cannot be told apart

    Sample point(int k) const { return {parts[0][k], parts[1][k]}; }

    void copy(int count, Sample* __restrict out) const {
        const float *re = parts[0].data(), *im = parts[1].data();
        for (int k = 0; k < count; k++) out[k] = {re[k], im[k]};
    }

    void resize(int count, int constellation) {
        sharpness.resize(count);
        for (auto& one : bits) one.resize(count);
        for (int axis = 0; axis < 2; axis++) {
            parts[axis].resize(count);
            means[axis].resize(count);
            squares[axis].resize(count);
        }
        likely.resize(static_cast<size_t>(count) * constellation);
    }
};

// The likeliest points, their parts apart.
struct Nearest {
    std::vector<float> real, imag;

    void resize(int count) {
        real.resize(count);
        imag.resize(count);
    }
};

class Constellation {
   public:
    // `marks`: per point, one per bit in the order they are sent.
    Constellation(const Sample* points, int count, int bits, const uint8_t* marks)
        : bits_(bits), points_(points, points + count), marks_(marks, marks + count * bits) {
        for (Sample point : points_) power_ += square(point) / count;
        int side = 1;
        while (side * side < count) side++;
        if (count == 2) {
            side_ = 2;
            axes_ = 1;
            levels_ = {points[0].real(), points[1].real()};
            apart_ = points[0].imag() == 0 && points[1].imag() == 0 && !marks[0] && marks[1];
        } else if (side * side == count) {
            side_ = side;
            axes_ = 2;
            for (int k = 0; k < side; k++) levels_.push_back(points[k].imag());
            apart_ = true;
            for (int k = 0; k < count; k++) {
                apart_ &= std::abs(points[k] - Sample(levels_[k / side], levels_[k % side])) < 1e-5f;
                for (int bit = 0; bit < bits; bit++) apart_ &= marks[k * bits + bit] == (k >> bit & 1);
            }
            apart_ &= side <= 8;
        }
    }

    int bits() const { return bits_; }
    int count() const { return static_cast<int>(points_.size()); }
    float power() const { return power_; }
    Sample point(int value) const { return points_[value]; }

    // The received points are there, and how sharp each is: how likely is what, where that is not told per axis?
    void weigh(Received& seen, int used) const {
        if (apart_) return;
        for (int i = 0; i < used; i++) {
            float* likely = &seen.likely[static_cast<size_t>(i) * count()];
            for (int k = 0; k < count(); k++) likely[k] = likelihood(seen.point(i), k) * seen.sharpness[i];
        }
    }

    // Mean of what was sent, given what was received, and of its squared magnitude.
    void expect(Received& seen, int used) const {
        if (!apart_) {
            expect_jointly(seen, used);
            return;
        }
        for (int axis = 0; axis < axes_; axis++) {
            switch (side_) {
                case 2: expect_axis<2>(seen, axis, used); break;
                case 4: expect_axis<4>(seen, axis, used); break;
                default: expect_axis<8>(seen, axis, used);
            }
        }
        if (axes_ == 1) {
            std::fill_n(seen.means[1].begin(), used, 0.0f);
            std::fill_n(seen.squares[1].begin(), used, 0.0f);
        }
    }

    // Soft bits in the order they were sent in, and the points they were read from.
    void soft(Received& seen, int used, float* out) const {
        if (!apart_) {
            soft_jointly(seen, used, out);
            return;
        }
        for (int axis = 0; axis < axes_; axis++) {
            switch (side_) {
                case 2: soft_axis<2>(seen, axis, used, out); break;
                case 4: soft_axis<4>(seen, axis, used, out); break;
                default: soft_axis<8>(seen, axis, used, out);
            }
        }
    }

    // Of each received point the likeliest one of the constellation.
    void nearest(const Sample* received, int used, Nearest& found) const {
        found.resize((used + kLanes - 1) / kLanes * kLanes);
        for (int at = 0; at < used; at += kLanes) {
            Sample some[kLanes] = {};
            std::copy_n(received + at, std::min(kLanes, used - at), some);
            const Four low = four(some), high = four(some + kLanes / 2);
            const Lanes x = GR_ROS2_MIX(Places, low, high, 0, 2, 4, 6, 8, 10, 12, 14);
            const Lanes y = GR_ROS2_MIX(Places, low, high, 1, 3, 5, 7, 9, 11, 13, 15);
            Lanes most = Lanes{} - INFINITY, real = Lanes{} + points_[0].real(), imag = Lanes{} + points_[0].imag();
            for (const Sample point : points_) {
                const Lanes likely = x * (2 * point.real()) + y * (2 * point.imag()) - square(point);
                const auto better = likely > most;
                most = better ? likely : most;
                real = better ? Lanes{} + point.real() : real;
                imag = better ? Lanes{} + point.imag() : imag;
            }
            put(real, &found.real[at]);
            put(imag, &found.imag[at]);
        }
    }

    // Soft bits of received points that are equally sharp.
    void soft(const Sample* received, int used, float sharpness, Nearest& work, float* out) const {
        work.resize(used);
        float *__restrict one = work.real.data(), *__restrict zero = work.imag.data();
        for (int bit = 0; bit < bits_; bit++) {
            std::fill_n(one, used, kLowest);
            std::fill_n(zero, used, kLowest);
            for (int k = 0; k < count(); k++) {
                const float twice[2] = {2 * points_[k].real(), 2 * points_[k].imag()}, power = square(points_[k]);
                float* __restrict most = marks_[k * bits_ + bit] ? one : zero;
                for (int i = 0; i < used; i++) {
                    const float likely = received[i].real() * twice[0] + received[i].imag() * twice[1] - power;
                    most[i] = std::max(most[i], likely * sharpness);
                }
            }
            for (int i = 0; i < used; i++) out[static_cast<size_t>(i) * bits_ + bit] = one[i] - zero[i];
        }
    }

    // Soft bits of one received point, from the likelihood of each point of the constellation.
    void soft_of(const float* likely, float* out) const {
        for (int bit = 0; bit < bits_; bit++) {
            float one = kLowest, zero = kLowest;
            for (int k = 0; k < count(); k++) {
                float& most = marks_[k * bits_ + bit] ? one : zero;
                most = std::max(most, likely[k]);
            }
            out[bit] = one - zero;
        }
    }

    // But for a constant of the received point, and the noise.
    float likelihood(Sample received, int k) const {
        const Sample point = points_[k];
        return 2 * (received.real() * point.real() + received.imag() * point.imag()) - square(point);
    }

   private:
    template <int Side>
    void expect_axis(Received& seen, int axis, int used) const {
        float twice[Side], squares[Side];
        for (int k = 0; k < Side; k++) {
            twice[k] = 2 * levels_[k];
            squares[k] = levels_[k] * levels_[k];
        }
        const float *received = seen.parts[axis].data(), *sharpness = seen.sharpness.data();
        float *mean = seen.means[axis].data(), *mean_square = seen.squares[axis].data();
        for (int i = 0; i < used; i++) {
            float likely[Side], most = kLowest;
            for (int k = 0; k < Side; k++) {
                likely[k] = (received[i] * twice[k] - squares[k]) * sharpness[i];
                most = likely[k] > most ? likely[k] : most;
            }
            float sum = 0, first = 0, second = 0;
            for (int k = 0; k < Side; k++) {
                const float weight = exp_below_0(likely[k] - most);
                sum += weight;
                first += weight * twice[k];
                second += weight * squares[k];
            }
            mean[i] = 0.5f * first / sum;
            mean_square[i] = second / sum;
        }
    }

    // The high bits of a value are those of its real part; a value's lowest bit is sent first.
    template <int Side>
    void soft_axis(Received& seen, int axis, int used, float* out) const {
        constexpr int each = Side == 2 ? 1 : Side == 4 ? 2 : 3;
        float twice[Side], squares[Side];
        for (int k = 0; k < Side; k++) {
            twice[k] = 2 * levels_[k];
            squares[k] = levels_[k] * levels_[k];
        }
        const float *received = seen.parts[axis].data(), *sharpness = seen.sharpness.data();
        float* found[each];
        for (int bit = 0; bit < each; bit++) found[bit] = bits_ == 1 ? out : seen.bits[bit].data();
        for (int i = 0; i < used; i++) {
            float likely[Side];
            for (int k = 0; k < Side; k++) likely[k] = (received[i] * twice[k] - squares[k]) * sharpness[i];
            for (int bit = 0; bit < each; bit++) {
                float one = kLowest, zero = kLowest;
                for (int k = 0; k < Side; k++) {
                    if (k >> bit & 1) one = likely[k] > one ? likely[k] : one;
                    else zero = likely[k] > zero ? likely[k] : zero;
                }
                found[bit][i] = one - zero;
            }
        }
        if (bits_ == 1) return;
        const int lowest = axes_ == 2 && axis == 0 ? each : 0;
        for (int bit = 0; bit < each; bit++) {
            for (int i = 0; i < used; i++) out[static_cast<size_t>(i) * bits_ + lowest + bit] = found[bit][i];
        }
    }

    void expect_jointly(Received& seen, int used) const {
        for (int i = 0; i < used; i++) {
            const float* likely = &seen.likely[static_cast<size_t>(i) * count()];
            float most = kLowest, sum = 0, real = 0, imag = 0, squares = 0;
            for (int k = 0; k < count(); k++) most = likely[k] > most ? likely[k] : most;
            for (int k = 0; k < count(); k++) {
                const float weight = exp_below_0(likely[k] - most);
                sum += weight;
                real += weight * points_[k].real();
                imag += weight * points_[k].imag();
                squares += weight * square(points_[k]);
            }
            seen.means[0][i] = real / sum;
            seen.means[1][i] = imag / sum;
            seen.squares[0][i] = squares / sum;
            seen.squares[1][i] = 0;
        }
    }

    void soft_jointly(const Received& seen, int used, float* out) const {
        for (int i = 0; i < used; i++)
            soft_of(&seen.likely[static_cast<size_t>(i) * count()], out + static_cast<size_t>(i) * bits_);
    }

    int bits_, side_ = 0, axes_ = 0;
    bool apart_ = false;
    float power_ = 0;
    std::vector<Sample> points_;
    std::vector<uint8_t> marks_;
    std::vector<float> levels_;
};

}  // namespace gr_ros2
