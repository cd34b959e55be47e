// The kernel of gr_ros2/phy/linear.py, whose methods have the same names and say why: psk and gfsk behind their filter.

#include "constellation.h"
#include "modem.h"

namespace gr_ros2 {
namespace {

constexpr double kTiny = 1e-30;
constexpr double kSmallestNoise = 1e-6;
constexpr int kPad = 4;       // FFT bins per bin of the preamble's length
constexpr int kSums = 4;      // 32 positions are searched at a time: two sums of each fit into registers
constexpr double kFar = 1e6;  // samples that no burst can be late
using Bits = std::vector<uint8_t>;
enum Digit { kOver, kZero, kOne, kDigits };  // of a sequence of bits: none, a zero, a one

// A preamble's symbols without their signs, in `symbols`, and the carrier that is left.
struct Carrier {
    double frequency, alike;
};

// A burst's carrier and first symbol.
struct Track {
    double begin, phase, frequency, snr;
};

struct Scratch {
    std::vector<Sample> head;                              // the points of the length word
    std::vector<float> head_soft;
    std::vector<float> re, im, power, match, chance;       // per sample, per position
    std::vector<Sample> symbols, spectrum, spare, rotation;  // per preamble symbol, per bin
    std::vector<Sample> raw, turned, other;                // per symbol of a chunk
    std::vector<float> heights;
    std::vector<double> drift, places, angles;
    Nearest decided;
    Bits sent;
};

Scratch& scratch() {
    static thread_local Scratch mine;
    return mine;
}

class Linear final : public Modem {
   public:
    explicit Linear(const LinearParameters& p)
        : p_(p),
          lengths_(p.shortest, p.longest, p.frame_bits),
          signs_(p.signs, p.signs + (lengths_.fixed() ? 0 : static_cast<size_t>(lengths_.count()) * kWordBits)),
          steps_(p.steps, p.steps + p.preamble - 1),
          known_(p.known, p.known + p.preamble),
          explained_(p.explained, p.explained + static_cast<size_t>(p.unknowns) * (p.preamble - 2 * p.edge)),
          points_(p.points, p.order, p.point_bits, p.marks),
          fft_(kPad * p.preamble),
          pulse_(p.pulse, p.pulse + (p.lead_len ? 0 : p.pulse_len)),
          sequences_(1),
          lead_(p.lead, p.lead + p.lead_len),
          tail_(p.tail, p.tail + p.tail_len) {
        for (int k = 0; p.lead_len && k < p.pulse_len / p.sps; k++) sequences_ *= kDigits;
        waves_.assign(p.waves, p.waves + (p.lead_len ? static_cast<size_t>(sequences_) * p.sps : 0));
    }

    Search find(Samples samples) const override {
        const int sps = p_.sps;
        const int64_t positions = samples.count - static_cast<int64_t>(p_.preamble - 1) * sps;
        if (positions <= 0) return {0, kNone};
        Scratch& s = prepared();
        correlate(samples, positions, s);
        const float *match = s.match.data(), *chance = s.chance.data();
        const auto level = static_cast<float>(p_.threshold * p_.threshold * (p_.preamble - 1));
        const int64_t rise = static_cast<int64_t>(p_.rise) * sps;
        for (int64_t at = 0; at < positions;) {
            int64_t first = at;
            while (first < positions && !(match[first] > level * chance[first] + static_cast<float>(kTiny))) first++;
            if (first == positions) break;
            if (first + rise > positions) return {first, kNone};  // the highest point may still be to come
            const int64_t best = first + argmax(match + first, static_cast<int>(rise));
            if (carrier(samples, best, s).alike > p_.alike) return {first, best};
            at = best + 1;
        }
        return {positions, kNone};
    }

    Result read(Samples samples, int64_t start, float* soft, Sample* points, Report* report) const override {
        if (start < 1 || start >= samples.count) return kNoBurst;
        Scratch& s = prepared();
        const Carrier found = carrier(samples, start, s);
        const Track track = measured(samples, start, found, s);
        report->snr = track.snr;
        const int length = lengths_.fixed() ? lengths_.longest() : said(samples, track, s);
        const int payload = symbols(length);
        report->length = length;
        report->end = start + needed(length);
        if (report->end > samples.count) return kCut;
        if (!follow(samples, track, payload, points, s)) return kNoBurst;
        decide(points, payload, soft, s);
        if (p_.differential) differ(soft, payload);
        const int skipped = lengths_.fixed() ? 0 : kWordBits;
        report->soft = static_cast<int64_t>(payload) * p_.point_bits - skipped;
        if (skipped) std::memmove(soft, soft + skipped, sizeof(float) * report->soft);
        report->points = payload;
        return kRead;
    }

    void modulate(const uint8_t* bits, int32_t length, Sample* out) const override {
        Bits& sent = scratch().sent;
        sent.clear();
        const float* word = lengths_.fixed() ? nullptr : &signs_[static_cast<size_t>(lengths_.row(length)) * kWordBits];
        for (int k = 0; word && k < kWordBits; k++) sent.push_back(word[k] > 0);
        sent.insert(sent.end(), bits, bits + lengths_.bits(length));
        if (p_.lead_len) modulate_frequency(sent, out);
        else modulate_phase(sent, p_.preamble + symbols(length), out);
    }

   private:
    // One pulse for each of `count` symbols.
    void modulate_phase(const Bits& sent, int count, Sample* out) const {
        const int most = p_.pulse_len;
        std::fill_n(out, static_cast<int64_t>(count - 1) * p_.sps + most, Sample());
        size_t taken = 0;
        for (int symbol = 0; symbol < count; symbol++, out += p_.sps) {
            Sample point;
            if (symbol < p_.preamble) point = known_[symbol];
            else {
                int value = 0;
                for (int bit = 0; bit < p_.point_bits; bit++, taken++)
                    value = 2 * value + (taken < sent.size() ? sent[taken] : 0);
                point = points_.point(value);
            }
            for (int k = 0; k < most; k++) out[k] += pulse_[k] * point;
        }
    }

    // A quarter turn per bit. The samples between two bits depend on the bits whose pulses are not over yet.
    void modulate_frequency(Bits& sent, Sample* out) const {
        if (!p_.differential)
            for (size_t k = sent.size(); k-- > 0;) sent[k] ^= 1 ^ (k ? sent[k - 1] : p_.last_one);
        const int pulse = p_.pulse_len / p_.sps;
        int sequence = 0, turns = 0;
        const auto add = [&](int digit) {
            const int over = sequence / (sequences_ / kDigits);
            turns += over == kOne ? 1 : over == kZero ? 3 : 0;
            sequence = sequence % (sequences_ / kDigits) * kDigits + digit;
            const Sample* wave = &waves_[static_cast<size_t>(sequence) * p_.sps];
            for (int k = 0; k < p_.sps; k++) out[k] = turned(wave[k], turns % 4);
            out += p_.sps;
        };
        const Bits& payload = sent;
        for (const Bits* part : {&lead_, &payload, &tail_})
            for (const uint8_t bit : *part) add(bit ? kOne : kZero);
        for (int k = 1; k < pulse; k++) add(kOver);
    }

    static Sample turned(Sample value, int quarters) {
        const Sample half = quarters & 2 ? -value : value;
        return quarters & 1 ? Sample(-half.imag(), half.real()) : half;
    }

    // Number of symbols after the preamble.
    int symbols(int length) const {
        const int bits = lengths_.bits(length) + (lengths_.fixed() ? 0 : kWordBits);
        return (bits + p_.point_bits - 1) / p_.point_bits;
    }

    // Number of samples from the reference sample on.
    int64_t needed(int length) const {
        return static_cast<int64_t>(p_.preamble + symbols(length) - 1) * p_.sps + 1 + p_.slack;
    }

    // Carrier, SNR and start of a burst, measured on its preamble.
    Track measured(Samples samples, int64_t start, const Carrier& found, Scratch& s) const {
        Track track;
        track.frequency = found.frequency + p_.turn;
        track.phase = straighten(found.frequency, s);
        track.snr = signal_to_noise(s);
        track.begin = static_cast<double>(start) + lateness(samples, start, found.frequency, s);
        return track;
    }

    // Bytes of the packet, from the symbols that even the shortest burst has.
    int said(Samples samples, const Track& track, Scratch& s) const {
        const int payload = symbols(lengths_.shortest());
        s.head.resize(payload);
        s.head_soft.resize(static_cast<size_t>(payload) * p_.point_bits);
        follow(samples, track, payload, s.head.data(), s);
        decide(s.head.data(), payload, s.head_soft.data(), s);
        if (p_.differential) differ(s.head_soft.data(), payload);
        return lengths_.shortest() + likeliest_word(signs_.data(), lengths_.count(), s.head_soft.data());
    }

    Scratch& prepared() const {
        Scratch& s = scratch();
        for (auto* one : {&s.symbols, &s.rotation}) one->resize(p_.preamble);
        for (auto* one : {&s.spectrum, &s.spare}) one->resize(fft_.size());
        for (auto* one : {&s.raw, &s.turned, &s.other}) one->resize(p_.chunk);
        s.heights.resize(fft_.size());
        s.drift.resize(p_.chunk);
        const int blocks = std::max(1, p_.chunk / p_.block);
        for (auto* one : {&s.places, &s.angles}) one->resize(blocks + 1);
        return s;
    }

    // Of each position, how much its phase steps are those of the preamble, and how much they would be by chance.
    void correlate(Samples samples, int64_t positions, Scratch& s) const {
        const int sps = p_.sps, count = p_.preamble - 1;
        const int64_t steps = samples.count - sps;
        for (auto* one : {&s.re, &s.im, &s.power}) one->resize(steps);
        for (auto* one : {&s.match, &s.chance}) one->resize(positions);
        float *re = s.re.data(), *im = s.im.data(), *power = s.power.data(), *chance = s.chance.data();
        for (int64_t k = 0; k < steps; k++) {
            const Sample p = mul_conj(samples.at[k + sps], samples.at[k]);
            re[k] = p.real();
            im[k] = p.imag();
            power[k] = square(p);
        }
        // Sums over `count` steps are made of sums over 1, 2, 4, ... of them.
        std::fill_n(chance, positions, 0.0f);
        int64_t known = steps;
        for (int64_t many = 1, over = 0; many <= count; many *= 2) {
            if (count & many) {
                for (int64_t k = 0; k < positions; k++) chance[k] += power[k + over * sps];
                over += many;
            }
            known -= many * sps;
            for (int64_t k = 0; 2 * many <= count && k < known; k++) power[k] += power[k + many * sps];
        }
        int64_t at = 0;
        for (; at + kSums * kLanes <= positions; at += kSums * kLanes) {
            Lanes a[kSums] = {}, b[kSums] = {};
            for (int j = 0; j < count; j++) {
                const int64_t from = at + static_cast<int64_t>(j) * sps;
                for (int k = 0; k < kSums; k++) {
                    Lanes one, other;
                    std::memcpy(&one, re + from + k * kLanes, sizeof one);
                    std::memcpy(&other, im + from + k * kLanes, sizeof other);
                    a[k] += steps_[j] * one;
                    b[k] += steps_[j] * other;
                }
            }
            for (int k = 0; k < kSums; k++) {
                const Lanes match = a[k] * a[k] + b[k] * b[k];
                std::memcpy(&s.match[at + k * kLanes], &match, sizeof match);
            }
        }
        for (; at < positions; at++) {
            float a = 0, b = 0;
            for (int j = 0; j < count; j++) {
                a += steps_[j] * re[at + static_cast<int64_t>(j) * sps];
                b += steps_[j] * im[at + static_cast<int64_t>(j) * sps];
            }
            s.match[at] = a * a + b * b;
        }
    }

    // Look closely at a preamble.
    Carrier carrier(Samples samples, int64_t at, Scratch& s) const {
        const int size = fft_.size();
        float power = 0;
        std::fill(s.spectrum.begin(), s.spectrum.end(), Sample());
        for (int k = 0; k < p_.preamble; k++) {
            const int64_t place = at + static_cast<int64_t>(k) * p_.sps;
            s.symbols[k] = place < samples.count ? mul_conj(samples.at[place], known_[k]) : Sample();
            s.spectrum[k] = s.symbols[k];
            power += square(s.symbols[k]);
        }
        fft_.run(s.spectrum.data(), s.spare.data());
        squares(s.spectrum.data(), size, s.heights.data());
        const int peak = argmax(s.heights.data(), size);
        const auto height = [&](int bin) { return std::sqrt(static_cast<double>(s.heights[bin & (size - 1)])); };
        const double place = peak + parabola_peak(height(peak - 1), height(peak), height(peak + 1));
        const double frequency = kTau * (wrapped(place + size / 2.0, size) - size / 2.0) / size;
        const double all = static_cast<double>(p_.preamble) * power;
        return {frequency, std::isfinite(power) ? s.heights[peak] / std::max(all, kTiny) : 0.0};
    }

    // Take the carrier from the preamble's symbols; returns their phase.
    double straighten(double frequency, Scratch& s) const {
        Rotation(0, -frequency).fill(s.rotation.data(), p_.preamble);
        double re = 0, im = 0;
        for (int k = 0; k < p_.preamble; k++) {
            s.symbols[k] = mul(s.symbols[k], s.rotation[k]);
            re += s.symbols[k].real();
            im += s.symbols[k].imag();
        }
        return std::atan2(im, re);
    }

    // Mean power of a burst over that of the noise, from its preamble's inner symbols.
    double signal_to_noise(const Scratch& s) const {
        const int inner = p_.preamble - 2 * p_.edge;
        const Sample* received = s.symbols.data() + p_.edge;
        double total = 0, explained = 0;
        for (int k = 0; k < inner; k++) total += square(received[k]);
        for (int u = 0; u < p_.unknowns; u++) {
            const Sample* column = &explained_[static_cast<size_t>(u) * inner];
            double re = 0, im = 0;
            for (int k = 0; k < inner; k++) {
                const Sample p = mul(column[k], received[k]);
                re += p.real();
                im += p.imag();
            }
            explained += re * re + im * im;
        }
        const double noise = std::max(total - explained, kTiny) / (inner - p_.unknowns);
        return (total - inner * noise) / (p_.clean_energy * noise);
    }

    // Samples by which the preamble's symbols lie behind `start`, -0.5..0.5.
    double lateness(Samples samples, int64_t start, double frequency, Scratch& s) const {
        Rotation(0, -frequency).fill(s.rotation.data(), p_.preamble);
        double heights[3];
        for (int off = -1; off <= 1; off++) {
            double re = 0, im = 0;
            for (int k = 0; k < p_.preamble; k++) {
                const int64_t place = start + off + static_cast<int64_t>(k) * p_.sps;
                if (place >= samples.count) break;
                const Sample p = mul(mul_conj(samples.at[place], known_[k]), s.rotation[k]);
                re += p.real();
                im += p.imag();
            }
            heights[off + 1] = std::sqrt(re * re + im * im);
        }
        return parabola_peak(heights[0], heights[1], heights[2]);
    }

    // The payload's points, straightened, in blocks and chunks; false where this cannot be a burst.
    bool follow(Samples samples, const Track& track, int payload, Sample* points, Scratch& s) const {
        const double begin = track.begin, phase = track.phase, frequency = track.frequency;
        const int order = p_.order;
        double late = 0, known_at = (p_.preamble - 1) / 2.0, known = 0;
        for (int first = 0; first < payload; first += p_.chunk) {
            const int count = std::min(p_.chunk, payload - first), symbol = first + p_.preamble;
            const double at = begin + late + static_cast<double>(symbol) * p_.sps;
            if (!(std::abs(late) < kFar)) return false;
            between(samples, at, count, s.raw.data());
            Rotation(-(phase + frequency * symbol), -frequency).fill(s.turned.data(), count);
            turn_by(s.turned.data(), count, s.raw.data());
            const int blocks = std::max(1, count / p_.block);
            s.places[0] = known_at;
            s.angles[0] = known;
            for (int b = 0; b < blocks; b++) {
                const int from = b * p_.block, to = b + 1 < blocks ? from + p_.block : count;
                const double angle = raised_angle(s.raw.data() + from, to - from), last = s.angles[b] * order;
                s.angles[b + 1] = (angle + kTau * std::nearbyint((last - angle) / kTau)) / order;
                s.places[b + 1] = symbol + (from + to - 1) / 2.0;
            }
            interpolate(blocks, symbol, count, s);
            for (int k = 0; k < count; k++) s.other[k] = unit_near(-s.drift[k]);
            products(s.raw.data(), s.other.data(), count, points + first);
            known_at = symbol + count - 1;
            known = s.drift[count - 1];
            if (first + count < payload) late += chunk_lateness(samples, at, points + first, count, s);
        }
        return true;
    }

    // Angle of symbols raised to the power of `order`, each as heavy as it is strong.
    double raised_angle(const Sample* symbols, int count) const {
        float re = 0, im = 0;
        for (int k = 0; k < count; k++) {
            const float power = square(symbols[k]) + static_cast<float>(kTiny), inverse = 1.0f / std::sqrt(power);
            Sample raised = symbols[k] * inverse;
            for (int doubled = 1; doubled < p_.order; doubled *= 2) raised = mul(raised, raised);
            re += raised.real() * power * inverse;
            im += raised.imag() * power * inverse;
        }
        return std::atan2(im, re);
    }

    // Phase of each symbol, on straight lines between the blocks' centres.
    void interpolate(int blocks, int symbol, int count, Scratch& s) const {
        int left = 0;
        for (int k = 0; k < count; k++) {
            const double at = symbol + k;
            while (left + 1 < blocks && at > s.places[left + 1]) left++;
            const double from = s.places[left], to = s.places[left + 1];
            const double share = std::max(0.0, std::min(1.0, (at - from) / (to - from)));
            s.drift[k] = s.angles[left] + (s.angles[left + 1] - s.angles[left]) * share;
        }
    }

    static Sample unit_near(double angle) {
        return {std::cos(static_cast<float>(angle)), std::sin(static_cast<float>(angle))};
    }

    // Samples by which a chunk's symbols came late, as their decisions say; `other` holds what straightened them.
    double chunk_lateness(Samples samples, double at, const Sample* points, int count, Scratch& s) const {
        points_.nearest(points, count, s.decided);
        turn_by(s.other.data(), count, s.turned.data());
        const float *real = s.decided.real.data(), *imag = s.decided.imag.data();
        Sample* __restrict turned = s.turned.data();
        for (int k = 0; k < count; k++) turned[k] = mul_conj(turned[k], {real[k], imag[k]});
        double heights[3];
        for (int off = -1; off <= 1; off++) {
            between(samples, at + off, count, s.other.data());
            float sum = 0;
            for (int k = 0; k < count; k++)
                sum += s.other[k].real() * s.turned[k].real() - s.other[k].imag() * s.turned[k].imag();
            heights[off + 1] = sum;
        }
        return parabola_peak(heights[0], heights[1], heights[2]);
    }

    // `count` values a symbol apart from a fractional place on, by cubic interpolation; zeros outside.
    void between(Samples samples, double at, int count, Sample* out) const {
        const double floor = std::floor(at), x = at - floor;
        const auto base = static_cast<int64_t>(floor);
        const float weights[4] = {
            static_cast<float>(-x * (x - 1) * (x - 2) / 6), static_cast<float>((x + 1) * (x - 1) * (x - 2) / 2),
            static_cast<float>(-(x + 1) * x * (x - 2) / 2), static_cast<float>((x + 1) * x * (x - 1) / 6)};
        const Four wide = {weights[0], weights[0], weights[1], weights[1], weights[2], weights[2], weights[3], weights[3]};
        int64_t place = base - 1;
        for (int k = 0; k < count; k++, place += p_.sps) {
            if (place >= 0 && place + 3 < samples.count) {
                const Four each = four(samples.at + place) * wide;
                out[k] = {each[0] + each[2] + each[4] + each[6], each[1] + each[3] + each[5] + each[7]};
            } else {
                Sample sum;
                for (int j = 0; j < 4; j++)
                    if (place + j >= 0 && place + j < samples.count) sum += weights[j] * samples.at[place + j];
                out[k] = sum;
            }
        }
    }

    // Points made as large as the constellation's, and their soft bits.
    void decide(Sample* points, int payload, float* soft, Scratch& s) const {
        double energy = 0, alike = 0, rest = 0;
        points_.nearest(points, payload, s.decided);
        const float *real = s.decided.real.data(), *imag = s.decided.imag.data();
        for (int k = 0; k < payload; k++) {
            energy += static_cast<double>(real[k] * real[k] + imag[k] * imag[k]);
            alike += static_cast<double>(points[k].real() * real[k] + points[k].imag() * imag[k]);
        }
        const double gain = std::max(alike / std::max(energy, 1e-20), 1e-20);
        const auto scale = static_cast<float>(gain);
        for (int k = 0; k < payload; k++)
            rest += static_cast<double>(square(points[k] - Sample(real[k] * scale, imag[k] * scale)));
        const double noise = rest / payload / (gain * gain);
        const auto sharpness = static_cast<float>(1 / std::max(noise, kSmallestNoise * points_.power()));
        const auto inverse = static_cast<float>(1 / gain);
        for (int k = 0; k < payload; k++) points[k] *= inverse;
        points_.soft(points, payload, sharpness, s.decided, soft);
    }

    // Bits that are 1 where a phase is that of the symbol before; the first one's before is the preamble's last.
    void differ(float* soft, int payload) const {
        float before = p_.last_one ? INFINITY : -INFINITY;
        for (int k = 0; k < payload; k++) {
            const float here = soft[k], least = std::min(std::abs(here), std::abs(before));
            soft[k] = here == 0 || before == 0 ? 0.0f : (here > 0) == (before > 0) ? least : -least;
            before = here;
        }
    }

    LinearParameters p_;  // its numbers; arrays are copied below
    Lengths lengths_;
    std::vector<float> signs_;
    std::vector<float> steps_;
    std::vector<Sample> known_, explained_;
    Constellation points_;
    Fft fft_;
    std::vector<float> pulse_;
    std::vector<Sample> waves_;
    int sequences_;  // rows of `waves_`
    Bits lead_, tail_;
};

}  // namespace

std::unique_ptr<Modem> make_linear(const LinearParameters& given) { return std::make_unique<Linear>(given); }

}  // namespace gr_ros2
