// The kernel of gr_ros2/phy/lora.py, whose methods have the same names and say why.

#include "modem.h"

namespace gr_ros2 {
namespace {

constexpr float kTiny = 1e-20f;
constexpr int kWords = 16, kNibble = 4, kMostCodeBits = 8;
constexpr int kMostBits = 16;  // of a chirp
constexpr int kBlock = 64;  // values interpolated at a time

struct Place {
    bool found;
    double begin, carrier, snr;
};

struct Scratch {
    std::vector<float> powers, pairs, falls, sum, heights, soft;
    std::vector<Sample> row, spare, fine, fine_spare, turned, tones, padded, peaks;
    std::vector<int> places;
};

Scratch& scratch() {
    static thread_local Scratch mine;
    return mine;
}

class Lora final : public Modem {
   public:
    explicit Lora(const LoraParameters& p)
        : p_(p),
          lengths_(p.shortest, p.longest, p.frame_bits),
          telling_(p.telling, p.telling + static_cast<size_t>(p.before) * lengths_.count()),
          down_(p.down_chirp, p.down_chirp + p.chips),
          up_(p.up_chirp, p.up_chirp + p.chips),
          tapered_(p.tapered, p.tapered + p.chips),
          words_(p.words, p.words + kWords),
          sync_word_(p.sync_word, p.sync_word + p.sync),
          roots_(p.chips),
          fft_(p.chips),
          fine_fft_(p.fine * p.chips) {
        for (int k = 0; k < p.chips; k++) roots_[k] = unit(kTau * k / p.chips);
    }

    Search find(Samples samples) const override {
        const int chips = p_.chips, look = p_.look;
        const int64_t count = samples.count / chips;
        if (count < look + 1) return {0, kNone};
        Scratch& s = prepared();
        for (auto* one : {&s.powers, &s.pairs}) one->resize(static_cast<size_t>(count) * chips);
        const auto limit = static_cast<float>(p_.limit), threshold = static_cast<float>(p_.threshold);
        const int64_t rows = count - look + 1;
        int64_t first = -1, best = -1;
        float highest = -1;
        for (int64_t symbol = 0; symbol < count; symbol++) {
            chirp_powers(samples.at + symbol * chips, &s.powers[symbol * chips], &s.pairs[symbol * chips], limit, s);
            const int64_t row = symbol - look + 1;
            if (row < 0) continue;
            const float top = added_up(&s.pairs[row * chips], s);
            if (first < 0 && top > threshold) {
                first = row;
                // A strong burst is seen as it comes in; the best place is yet to come.
                if (first + look >= rows) return {first * chips, kNone};
            }
            if (first < 0) continue;
            if (top > highest) {
                highest = top;
                best = row;
            }
            if (row == first + look) break;
        }
        if (first < 0) return {(count - look) * chips, kNone};
        std::fill(s.sum.begin(), s.sum.end(), 0.0f);
        for (int j = 0; j < look; j++) {
            const float* powers = &s.powers[(best + j) * chips];
            for (int k = 0; k < chips; k++) s.sum[k] += std::min(powers[k], limit);
        }
        const int late = argmax(s.sum.data(), chips);
        return {first * chips, best * chips + (chips - late) % chips};
    }

    Result read(Samples samples, int64_t start, float* soft, Sample* points, Report* report) const override {
        Scratch& s = prepared();
        const Place place = look(samples, start, s);
        if (!place.found) return kNoBurst;
        const int chips = p_.chips;
        straighten(place, s);
        const int length = said(samples, place, s), payload = symbols(length);
        *report = {place.snr, ending(place, length), length, static_cast<int64_t>(payload / p_.code_bits) *
                   p_.spreading_factor * kNibble, payload, 0};
        if (report->end > samples.count) return kCut;
        double begin = place.begin + static_cast<double>(p_.before) * chips, pace = 0;
        for (int first = 0; first < payload; first += p_.step) {
            const int count = std::min(p_.step, payload - first);
            delayed(samples, begin + static_cast<double>(first) * chips, count * chips, s);
            chirp_bits(count, points + first, &s.soft[static_cast<size_t>(first) * p_.spreading_factor], s);
            const double late = lateness(count, s);
            pace -= p_.pace_gain * late;
            begin += pace - p_.gain * late;
        }
        collect(s.soft.data(), payload, soft);
        return kRead;
    }

    void modulate(const uint8_t* bits, int32_t length, Sample* out) const override {
        for (int k = p_.head - p_.sync - p_.down; k > 0; k--) out = chirp(0, out);
        for (const int start : sync_word_) out = chirp(start, out);
        for (int k = 0; k < p_.down; k++) out = std::copy(down_.begin(), down_.end(), out);
        const int* told = telling_.data() + static_cast<size_t>(lengths_.row(length)) * p_.before;
        for (int k = 0; k < p_.before; k++) out = chirp(told[k], out);
        const int given = lengths_.bits(length), factor = p_.spreading_factor;
        int words[kMostBits];
        for (int first = 0; first < given; first += kNibble * factor) {
            for (int row = 0; row < factor; row++) {
                int nibble = 0;
                for (int at = first + row * kNibble, bit = 0; bit < kNibble; bit++, at++)
                    nibble = 2 * nibble + (at < given ? bits[at] : 0);
                words[row] = words_[nibble];
            }
            for (int column = 0; column < p_.code_bits; column++) {  // diagonal interleaver, Gray code
                int value = 0;
                for (int row = 0; row < factor; row++) value |= (words[(row + column) % factor] >> column & 1) << row;
                for (int shift = 1; shift <= 8; shift *= 2) value ^= value >> shift;
                out = chirp(value, out);
            }
        }
    }

   private:
    // An up-chirp from a start position on.
    Sample* chirp(int start, Sample* out) const {
        out = std::copy(up_.begin() + start, up_.end(), out);
        return std::copy(up_.begin(), up_.begin() + start, out);
    }

    // Number of chirps of the payload.
    int symbols(int length) const {
        const int block = kNibble * p_.spreading_factor;
        return (lengths_.bits(length) + block - 1) / block * p_.code_bits;
    }

    // The end of a burst may be a few samples late, because of the clocks and the channel.
    int64_t ending(const Place& place, int length) const {
        return std::llrint(place.begin) + static_cast<int64_t>(p_.before + symbols(length)) * p_.chips - p_.sinc;
    }

    // Fill `turned` with the factors that turn chirps into tones.
    void straighten(const Place& place, Scratch& s) const {
        Rotation(0, -kTau * place.carrier / p_.chips).fill(s.turned.data(), p_.chips);
        for (int k = 0; k < p_.chips; k++) s.turned[k] = mul(s.turned[k], down_[k]);
    }

    // Bytes of the packet, from the chirps before the payload.
    int said(Samples samples, const Place& place, Scratch& s) const {
        if (!p_.before) return lengths_.longest();
        const int chips = p_.chips;
        s.heights.resize(static_cast<size_t>(std::max(p_.before, p_.step)) * chips);
        for (int chirp = 0; chirp < p_.before; chirp++) {
            delayed(samples, place.begin + static_cast<double>(chirp) * chips, chips, s);
            std::copy_n(s.tones.begin(), chips, s.row.begin());
            fft_.run(s.row.data(), s.spare.data());
            for (int k = 0; k < chips; k++) s.heights[static_cast<size_t>(chirp) * chips + k] = std::sqrt(square(s.row[k]));
        }
        int best = 0;
        float most = -1;
        const int32_t* places = telling_.data();
        for (int row = 0; row < lengths_.count(); row++, places += p_.before) {
            float sum = 0;
            for (int chirp = 0; chirp < p_.before; chirp++) sum += s.heights[static_cast<size_t>(chirp) * chips + places[chirp]];
            if (sum > most) {
                most = sum;
                best = row;
            }
        }
        return lengths_.shortest() + best;
    }

    Scratch& prepared() const {
        Scratch& s = scratch();
        const size_t chips = p_.chips, fine = static_cast<size_t>(p_.fine) * chips, chunk = p_.step * chips;
        for (auto* one : {&s.row, &s.spare, &s.turned}) one->resize(chips);
        for (auto* one : {&s.fine, &s.fine_spare}) one->resize(fine);
        s.sum.resize(fine);
        s.falls.resize((p_.head + 1) * fine);
        s.tones.resize(chunk);
        s.heights.resize(chunk);
        s.places.resize(p_.step);
        s.peaks.resize(p_.step);
        s.padded.resize(chunk + 2 * p_.sinc);
        s.soft.resize(static_cast<size_t>(symbols(lengths_.longest())) * p_.spreading_factor);
        return s;
    }

    // Powers of a window's tones over their mean, and of each two neighbours as far as they count; none of a window that
    // holds what is no number.
    void chirp_powers(const Sample* window, float* powers, float* pairs, float limit, Scratch& s) const {
        const int chips = p_.chips;
        for (int k = 0; k < chips; k++) s.row[k] = mul(window[k], down_[k]);
        fft_.run(s.row.data(), s.spare.data());
        float sum = 0;
        for (int k = 0; k < chips; k++) {
            powers[k] = square(s.row[k]);
            sum += powers[k];
        }
        const float inverse = 1.0f / std::max(sum / chips, kTiny);
        if (!std::isfinite(sum)) {
            std::fill_n(powers, chips, 0.0f);
            std::fill_n(pairs, chips, 0.0f);
            return;
        }
        for (int k = 0; k < chips; k++) powers[k] *= inverse;
        pairs[0] = std::min(powers[0] + powers[chips - 1], limit);
        for (int k = 1; k < chips; k++) pairs[k] = std::min(powers[k] + powers[k - 1], limit);
    }

    // The most that `look` chirps add up to in one bin.
    float added_up(const float* pairs, Scratch& s) const {
        const int chips = p_.chips;
        std::copy_n(pairs, chips, s.sum.begin());
        for (int j = 1; j < p_.look; j++) {
            const float* row = pairs + static_cast<size_t>(j) * chips;
            for (int k = 0; k < chips; k++) s.sum[k] += row[k];
        }
        return largest(s.sum.data(), chips);
    }

    // Look closely at a preamble.
    Place look(Samples samples, int64_t start, Scratch& s) const {
        const Place none{false, 0, 0, 0};
        const int chips = p_.chips, fine = p_.fine * chips;
        if (start < 0) return none;
        const auto rows = static_cast<int>(std::min<int64_t>(p_.head + 1, (samples.count - start) / chips));
        if (rows < 2) return none;
        for (int row = 0; row < rows; row++)
            spectrum(samples.at + start + static_cast<int64_t>(row) * chips, up_, &s.falls[static_cast<size_t>(row) * fine], s);
        float power = 0;
        for (size_t k = 0; k < static_cast<size_t>(rows) * fine; k++) power += s.falls[k];
        if (!std::isfinite(power)) return none;
        int at = 0;
        float highest = -1;
        for (int row = 0; row + 1 < rows; row++) {
            const float *one = &s.falls[static_cast<size_t>(row) * fine], *two = one + fine;
            for (int k = 0; k < fine; k++) s.sum[k] = one[k] + two[k];
            const float top = largest(s.sum.data(), fine);
            if (top > highest) {
                highest = top;
                at = row;
            }
        }
        if (at < p_.sync + 1) return none;
        const float *one = &s.falls[static_cast<size_t>(at) * fine], *two = one + fine;
        for (int k = 0; k < fine; k++) s.sum[k] = one[k] + two[k];
        double fall = bin(s.sum.data());
        add_up(samples.at + start, at - p_.sync, down_, s);
        double rise = bin(s.sum.data());
        const int64_t begin = start + static_cast<int64_t>(at + p_.down) * chips + std::llrint((fall - rise) / 2);
        // Once more where the windows meet the chirps.
        const int64_t first = begin - static_cast<int64_t>(p_.down + p_.sync + p_.look) * chips;
        if (first < 0 || begin > samples.count) return none;
        add_up(samples.at + first, p_.look, down_, s);
        rise = bin(s.sum.data());
        const float top = largest(s.sum.data(), fine);
        add_up(samples.at + begin - static_cast<int64_t>(p_.down) * chips, p_.down, up_, s);
        fall = bin(s.sum.data());
        return {true, static_cast<double>(begin) + (fall - rise) / 2, (fall + rise) / 2,
                signal_to_noise(samples.at + first, top, s)};
    }

    // Spectrum of a window against a chirp, `fine` places a bin.
    void spectrum(const Sample* window, const std::vector<Sample>& chirp, float* out, Scratch& s) const {
        const int chips = p_.chips, fine = p_.fine * chips;
        for (int k = 0; k < chips; k++) s.fine[k] = mul(window[k], chirp[k]);
        std::fill(s.fine.begin() + chips, s.fine.begin() + fine, Sample());
        fine_fft_.run(s.fine.data(), s.fine_spare.data());
        for (int k = 0; k < fine; k++) out[k] = square(s.fine[k]);
    }

    // The same of several windows, into `sum`.
    void add_up(const Sample* window, int count, const std::vector<Sample>& chirp, Scratch& s) const {
        const int fine = p_.fine * p_.chips;
        std::fill_n(s.sum.begin(), fine, 0.0f);
        float* one = s.falls.data();  // what was there has been used
        for (int row = 0; row < count; row++, window += p_.chips) {
            spectrum(window, chirp, one, s);
            for (int k = 0; k < fine; k++) s.sum[k] += one[k];
        }
    }

    // The strongest place of such a spectrum, in bins either side of 0.
    double bin(const float* powers) const {
        const int fine = p_.fine * p_.chips, top = argmax(powers, fine);
        const double place = top + parabola_peak(powers[(top - 1 + fine) % fine], powers[top], powers[(top + 1) % fine]);
        return wrapped(place / p_.fine + p_.chips / 2.0, p_.chips) - p_.chips / 2.0;
    }

    // Power of a burst over that of the noise; `top`: of the spectrum that its up-chirps add up to.
    double signal_to_noise(const Sample* chirps, float top, Scratch& s) const {
        const int chips = p_.chips;
        float* powers = s.falls.data();
        std::fill_n(powers, chips, 0.0f);
        for (int row = 0; row < p_.look; row++, chirps += chips) {
            for (int k = 0; k < chips; k++) s.row[k] = mul(chirps[k], tapered_[k]);
            fft_.run(s.row.data(), s.spare.data());
            for (int k = 0; k < chips; k++) powers[k] += square(s.row[k]);
        }
        std::nth_element(powers, powers + chips / 2, powers + chips);
        const double median = (static_cast<double>(powers[chips / 2]) + *std::max_element(powers, powers + chips / 2)) / 2;
        const double noise = std::max(median * p_.median_share, static_cast<double>(kTiny));
        return (top / (static_cast<double>(p_.look) * chips) - noise) / (noise * chips);
    }

    // `count` samples from a fractional place on, by a windowed sinc, turned into tones; zeros outside.
    void delayed(Samples samples, double at, int count, Scratch& s) const {
        const int sinc = p_.sinc, needed = count + 2 * sinc - 1;
        const double floor = std::floor(at);
        const int64_t from = static_cast<int64_t>(floor) - sinc + 1;
        float taps[64];
        for (int k = 0; k < 2 * sinc; k++) {
            const double x = k - sinc + 1 - (at - floor), angle = kTau / 2 * x;
            const double taper = std::cos(angle / (2 * sinc + 2));
            taps[k] = static_cast<float>((std::abs(angle) < 1e-12 ? 1.0 : std::sin(angle) / angle) * taper * taper);
        }
        const bool inside = from >= 0 && from + needed <= samples.count;
        const Sample* in = inside ? samples.at + from : s.padded.data();
        if (!inside) {
            std::fill(s.padded.begin(), s.padded.end(), Sample());
            const int64_t begin = std::max<int64_t>(0, from), end = std::min(samples.count, from + needed);
            if (begin < end) std::copy(samples.at + begin, samples.at + end, s.padded.begin() + (begin - from));
        }
        // Real and imaginary parts lie side by side, and every tap moves on by both.
        const float* parts = reinterpret_cast<const float*>(in);
        float* out = reinterpret_cast<float*>(s.tones.data());
        for (int at_part = 0; at_part < 2 * count; at_part += kBlock) {
            float sum[kBlock] = {};
            const int width = std::min(kBlock, 2 * count - at_part);
            for (int k = 0; k < 2 * sinc; k++) {
                const float* moved = parts + at_part + 2 * k;
                if (width == kBlock)
                    for (int j = 0; j < kBlock; j++) sum[j] += taps[k] * moved[j];
                else
                    for (int j = 0; j < width; j++) sum[j] += taps[k] * moved[j];
            }
            std::copy_n(sum, width, out + at_part);
        }
        for (int symbol = 0; symbol < count; symbol += p_.chips)
            for (int k = 0; k < p_.chips; k++) s.tones[symbol + k] = mul(s.tones[symbol + k], s.turned[k]);
    }

    // Log-likelihood ratios of the bits of chirps, from the height of each bin.
    void chirp_bits(int count, Sample* points, float* soft, Scratch& s) const {
        const int chips = p_.chips;
        double peaks = 0, rest = 0;
        float highest = 0;
        for (int symbol = 0; symbol < count; symbol++) {
            std::copy_n(&s.tones[static_cast<size_t>(symbol) * chips], chips, s.row.begin());
            fft_.run(s.row.data(), s.spare.data());
            float* heights = &s.heights[static_cast<size_t>(symbol) * chips];
            squares(s.row.data(), chips, heights);
            float power = 0;
            for (int k = 0; k < chips; k++) {
                power += heights[k];
                heights[k] = std::sqrt(heights[k]);
            }
            const int peak = argmax(heights, chips);
            s.places[symbol] = peak;
            s.peaks[symbol] = s.row[peak];
            peaks += heights[peak];
            rest += power - heights[peak] * heights[peak];
            highest = std::max(highest, heights[peak]);
        }
        const double noise = std::max(rest / count / (chips - 1), static_cast<double>(kTiny));
        const auto scale = static_cast<float>(2 * peaks / count / noise), certain = static_cast<float>(p_.certain);
        for (int symbol = 0; symbol < count; symbol++) {
            points[symbol] = s.peaks[symbol] / std::max(highest, kTiny);
            float differences[kMostBits];
            differ(&s.heights[static_cast<size_t>(symbol) * chips], differences);
            for (int bit = 0; bit < p_.spreading_factor; bit++) {
                const float found = differences[bit] * scale;
                *soft++ = found > -certain ? (found < certain ? found : certain) : -certain;
            }
        }
    }

    // Of each bit, the highest bin whose Gray code has it, less the highest that has not. The Gray codes of bins have bit
    // 0 in the second and third of each four; the same is true of bit 1 and pairs of bins, and so on. Heights are lost.
    void differ(float* heights, float* out) const {
        int count = p_.chips;
        for (int bit = 0; bit < p_.spreading_factor - 1; bit++, count /= 2) {
            float one = -1, zero = -1;
            for (int k = 0; k < count; k += 4) {
                const float inner = std::max(heights[k + 1], heights[k + 2]), outer = std::max(heights[k], heights[k + 3]);
                one = inner > one ? inner : one;
                zero = outer > zero ? outer : zero;
            }
            out[bit] = one - zero;
            for (int k = 0; k < count / 2; k++) heights[k] = std::max(heights[2 * k], heights[2 * k + 1]);
        }
        out[p_.spreading_factor - 1] = heights[1] - heights[0];
    }

    // Samples by which windows lie behind their chirps, -0.5..0.5.
    double lateness(int count, const Scratch& s) const {
        const int chips = p_.chips, mask = chips - 1;
        double power = 0, turned = 0;
        for (int symbol = 0; symbol < count; symbol++) {
            const Sample* tone = &s.tones[static_cast<size_t>(symbol) * chips];
            const int peak = s.places[symbol];
            float whole_re = 0, whole_im = 0, part_re = 0, part_im = 0;
            for (int k = 0; k < chips; k++) {
                const Sample still = mul(tone[k], roots_[static_cast<unsigned>(-peak * k) & mask]);
                const float frequency = static_cast<float>((k + peak) & mask) / chips - 0.5f;
                whole_re += still.real();
                whole_im += still.imag();
                part_re += still.real() * frequency;
                part_im += still.imag() * frequency;
            }
            power += static_cast<double>(whole_re) * whole_re + static_cast<double>(whole_im) * whole_im;
            turned += static_cast<double>(part_im) * whole_re - static_cast<double>(part_re) * whole_im;
        }
        const double late = turned * 6 / (kTau / 2 * std::max(power, static_cast<double>(kTiny)));
        return late > -0.5 ? (late < 0.5 ? late : 0.5) : -0.5;
    }

    // Soft bits of chirps to those of the frame, through the likeliest code words.
    void collect(const float* soft, int payload, float* out) const {
        const int sf = p_.spreading_factor;
        for (int block = 0; block < payload / p_.code_bits; block++, soft += p_.code_bits * sf) {
            for (int word = 0; word < sf; word++, out += kNibble) {
                float coded[kMostCodeBits], likely[kWords];
                for (int j = 0; j < p_.code_bits; j++) coded[j] = soft[j * sf + (word + sf * kMostCodeBits - j) % sf];
                for (int q = 0; q < kWords; q++) {
                    float sum = 0;
                    for (int j = 0; j < p_.code_bits; j++) sum += words_[q] >> j & 1 ? coded[j] : -coded[j];
                    likely[q] = sum / 2;
                }
                for (int bit = 0; bit < kNibble; bit++) {
                    float one = -1e30f, zero = -1e30f;
                    for (int q = 0; q < kWords; q++) {
                        float& most = q >> (kNibble - 1 - bit) & 1 ? one : zero;
                        most = likely[q] > most ? likely[q] : most;
                    }
                    out[bit] = one - zero;
                }
            }
        }
    }

    LoraParameters p_;  // its numbers; arrays are copied below
    Lengths lengths_;
    std::vector<int32_t> telling_;
    std::vector<Sample> down_, up_, tapered_;
    std::vector<int32_t> words_, sync_word_;
    std::vector<Sample> roots_;
    Fft fft_, fine_fft_;
};

}  // namespace

std::unique_ptr<Modem> make_lora(const LoraParameters& given) { return std::make_unique<Lora>(given); }

}  // namespace gr_ros2
