// The kernel of gr_ros2/phy/ofdm_modem.py, whose methods have the same names and say why.

#include "constellation.h"
#include "modem.h"

namespace gr_ros2 {
namespace {

constexpr double kTiny = 1e-20;
constexpr int kHead = 3;          // two sync words and the header
constexpr int kFieldBits = 12;     // bits of each header field: length, number
constexpr int kLeastTone = 8;     // places on a turn for each symbol that `tone` looks at
constexpr float kSmallestNoise = 1e-6f;
constexpr double kFar = 1e6;         // samples that no burst can be late

struct Place {
    int64_t begin;
    double frequency;
    bool found;
    double pace = 0, delay = 0, variance = 1;
};

struct Lateness {
    double late, variance;
};

inline float sum(Lanes values) {
    float all = 0;
    for (int k = 0; k < kLanes; k++) all += values[k];
    return all;
}

// As many complex numbers at a time.
struct Group {
    Lanes re, im;

    Group times(Group b) const { return {re * b.re - im * b.im, re * b.im + im * b.re}; }
    Group times(Sample b) const { return {re * b.real() - im * b.imag(), re * b.imag() + im * b.real()}; }
    Group times_conj(Group b) const { return {re * b.re + im * b.im, im * b.re - re * b.im}; }
    void add(Group b) {
        re += b.re;
        im += b.im;
    }
};

// Complex numbers whose parts stand apart.
struct Split {
    std::vector<float> re, im;

    Split() = default;
    explicit Split(size_t count) : re(count), im(count) {}

    void resize(size_t count) {
        re.resize(count);
        im.resize(count);
    }
    Sample at(size_t k) const { return {re[k], im[k]}; }
    void set(size_t k, Sample value) {
        re[k] = value.real();
        im[k] = value.imag();
    }
    Group group(size_t k) const { return {lanes(&re[k]), lanes(&im[k])}; }
    void set(size_t k, Group values) {
        put(values.re, &re[k]);
        put(values.im, &im[k]);
    }
};

// When a burst's symbols come: a Kalman filter of their timing and its rate of change.
struct Clock {
    double begin, pace, symbol, own, both, rate;  // the last three: variances

    Clock(const Place& place, double expected) {
        const double share = expected / (expected + place.variance);
        begin = static_cast<double>(place.begin) - share * place.delay / 2;
        pace = share * place.delay;
        symbol = 0.5;
        own = both = 0;
        rate = share * place.variance;
    }

    void after(double at, Lateness seen) {
        const double step = at - symbol;
        own += step * (2 * both + step * rate);
        both += step * rate;
        const double share = own / (own + seen.variance), turn = both / (own + seen.variance);
        const double faster = pace + turn * seen.late;
        begin += share * seen.late + (pace - faster) * at;
        pace = faster;
        symbol = at;
        rate -= turn * both;
        own *= 1 - share;
        both *= 1 - share;
    }
};

// What a call works in.
struct Scratch {
    std::vector<double> products[2], powers;                       // running sums
    std::vector<Sample> rotation, first, second, profile, spare;   // an FFT long
    std::vector<Sample> powers_of;                                 // of a turn: none to half an FFT
    Split rows, model, turns;                                      // a chunk of symbols by `wide_` carriers
    std::vector<float> energies, heights;
    Split gains, before, sum, step, known, taken;                  // per carrier
    std::vector<float> weight, total;
    Split inverse;                                                 // per data carrier
    std::vector<float> sharpness, header;
    std::vector<Sample> tone, straight;                            // per symbol
    std::vector<Sample> again, burst;                              // at the pace of this clock
    Received seen;
};

Scratch& scratch() {
    static thread_local Scratch mine;
    return mine;
}

template <typename T>
std::vector<T> copied(const T* from, size_t count) {
    return std::vector<T>(from, from + count);
}

// A matrix column by column, for sums that stand side by side. Its rows are filled up to a multiple of `kLanes`.
class Matrix {
   public:
    Matrix() = default;
    Matrix(const std::vector<Sample>& columns, int count, int wide) : count_(count), wide_(wide), columns_(count * wide) {
        for (int column = 0; column < count; column++)
            for (int row = 0; row < count; row++) columns_.set(column * wide + row, columns[column * count + row]);
    }

    void times(const Split& vector, Split& out) const {
        int row = 0;
        for (; row + 4 * kLanes <= wide_; row += 4 * kLanes) rows<4>(vector, row, out);
        switch ((wide_ - row) / kLanes) {
            case 3: rows<3>(vector, row, out); break;
            case 2: rows<2>(vector, row, out); break;
            case 1: rows<1>(vector, row, out);
        }
    }

   private:
    // The sums of some rows stay in registers.
    template <int Many>
    void rows(const Split& vector, int row, Split& out) const {
        Group sums[Many] = {};
        for (int column = 0; column < count_; column++) {
            const Sample by = vector.at(column);
            for (int k = 0; k < Many; k++) sums[k].add(columns_.group(column * wide_ + row + k * kLanes).times(by));
        }
        for (int k = 0; k < Many; k++) out.set(row + k * kLanes, sums[k]);
    }

    int count_ = 0, wide_ = 0;
    Split columns_;
};

Constellation bpsk() {
    const Sample points[2] = {{-1, 0}, {1, 0}};
    const uint8_t marks[2] = {0, 1};
    return Constellation(points, 2, 1, marks);
}

class Ofdm final : public Modem {
   public:
    explicit Ofdm(const OfdmParameters& p)
        : p_(p),
          lengths_(p.shortest, p.longest, p.frame_bits),
          symbol_(p.size + p.prefix),
          half_(p.size / 2),
          window_(symbol_ - p.size / 2),
          back_(p.prefix / 4),
          used_(p.carrier_count),
          wide_((p.carrier_count + kLanes - 1) / kLanes * kLanes),
          carriers_(copied(p.carriers, p.carrier_count)),
          pilots_(copied(p.pilots, p.pilot_count)),
          once_(copied(p.once, p.once_count)),
          twice_(copied(p.twice, p.twice_count)),
          shifts_(copied(p.shifts, p.shift_count)),
          words_(copied(p.words, 2 * used_)),
          known_(copied(p.known, used_)),
          turns_(copied(p.turns, static_cast<size_t>(p.shift_count) * p.size)),
          whole_(copied(p.whole, 2 * p.size)),
          crosswise_(copied(p.crosswise, 2 * p.twice_count)),
          advances_(copied(p.advances, static_cast<size_t>(p.delay_count) * p.size)),
          headers_(copied(p.headers, static_cast<size_t>(p.mcs_count) * lengths_.count() * kWordBits)),
          header_mask_(copied(p.header_mask, p.data_count)),
          word_weight_(copied(p.word_weight, used_)),
          delays_(copied(p.delays, p.delay_count)),
          weights_(copied(p.weights, static_cast<size_t>(p.fractions + 1) * p.weight_count)),
          bpsk_(bpsk()),
          fft_(p.size) {
        arrange(p);
        const Sample* points = p.points;
        const uint8_t* marks = p.marks;
        for (int mcs = 0; mcs < p.mcs_count; mcs++) {
            const int count = p.point_counts[mcs], bits = p.point_bits[mcs];
            rates_.push_back({Lengths(p.shortest, p.longest, p.frame_bits + mcs * lengths_.count()),
                              Constellation(points, count, bits, marks)});
            most_points_ = std::max(most_points_, count);
            points += count;
            marks += count * bits;
        }
        for (int mcs = 0; mcs < p.mcs_count; mcs++)
            longest_ = std::max(longest_, symbols({mcs, lengths_.longest()}) * symbol_);
        for (uint8_t bit : headers_) signs_.push_back(bit ? 1.0f : -1.0f);
        for (int carrier : carriers_) {
            bins_.push_back((carrier + p.size) % p.size);
            places_.push_back(kTau / p.size * carrier);
        }
        bins_.resize(wide_);
        places_.resize(wide_);
        for (int size = kLeastTone; size <= kLeastTone * std::max(p.chunk, 1); size *= 2) tones_.emplace_back(size, p.reach);
    }

    Search find(Samples samples) const override {
        const int64_t positions = samples.count - 2 * symbol_ - p_.prefix;
        if (positions <= 0) return {0, kNone};
        Scratch& s = prepared();
        const int64_t count = positions + window_ + half_;
        sum_up(samples.at, count, s);
        const double all = s.powers[count];
        if (!(all <= 1e38)) return {positions, kNone};  // numpy's sums are no numbers from there on either
        const double least = kTiny * (all + kTiny), level = p_.level;
        const double *re = s.products[0].data(), *im = s.products[1].data(), *power = s.powers.data();
        const auto both = [&](int64_t k) {
            return 0.5 * (power[k + window_] - power[k] + power[k + half_ + window_] - power[k + half_]);
        };
        const auto repeated = [&](int64_t k) {
            const double a = re[k + window_] - re[k], b = im[k + window_] - im[k];
            return a * a + b * b;
        };
        const double root = std::sqrt(level);
        for (int64_t at = 0; at < positions;) {
            int64_t first = at;
            for (; first < positions; first++) {
                const double least_here = root * both(first) + least;
                if (least_here < 0 || repeated(first) > least_here * least_here) break;
            }
            if (first == positions) break;
            if (first + symbol_ > positions) return {first, kNone};  // the highest point may still be to come
            int64_t best = first;
            double highest = -1;
            for (int64_t k = first; k < first + symbol_; k++) {
                const double below = both(k) + kTiny, ratio = repeated(k) / (below * below);
                if (ratio > highest) {
                    highest = ratio;
                    best = k;
                }
            }
            const Place place = placed(samples, best, s);
            if (place.found) return {std::max<int64_t>(0, std::min(first, place.begin)), place.begin};
            at = best + 1;
        }
        return {positions, kNone};
    }

    Result read(Samples samples, int64_t start, float* soft, Sample* seen, Report* report) const override {
        Scratch& s = prepared();
        Place place = placed(samples, start, s);
        const int64_t given = samples.count;
        int64_t from = start, more = 0;
        double step = 1;
        if (place.pace != 0) {
            from = place.begin;
            step += place.pace;
            more = p_.weight_count / 2;
            const int64_t have = static_cast<int64_t>((given - place.begin) / step);
            const int64_t count = std::max<int64_t>(1, std::min<int64_t>(have, longest_) + p_.prefix);
            stretch(samples, place.begin - p_.prefix * step, place.pace, count, s.burst);
            samples = {s.burst.data(), count};
            place = look(samples, p_.prefix, s);
        }
        Clock clock(place, p_.clocks);
        spectra(samples, clock, place.frequency, 0, kHead, s);
        const float noise = first_estimate(s);
        report->snr = signal_to_noise(s);
        const Told told = head(s, noise, clock);
        const Constellation& points = rates_[told.mcs].points;
        const int all = points_of(told), count = symbols(told) - kHead;
        report->length = told.length;
        report->mcs = told.mcs;
        report->end = from + std::llrint((static_cast<double>(symbols(told)) * symbol_ - back_) * step) + more;
        if (report->end > given) return kCut;
        report->points = all;
        report->soft = static_cast<int64_t>(all) * points.bits();
        int done = 0;
        for (int first = 0; first < count; first += p_.chunk) {
            const int rows = std::min(p_.chunk, count - first);
            const int used = std::min(rows * p_.data_count, all - first * p_.data_count);
            spectra(samples, clock, place.frequency, kHead + first, rows, s);
            const Lateness seen_late = decide(s, 0, rows, noise, points, used, 2);
            if (!(std::abs(seen_late.late) < kFar)) return kNoBurst;
            points.soft(s.seen, used, soft + static_cast<size_t>(done) * points.bits());
            s.seen.copy(used, seen + done);
            done += used;
            clock.after(kHead + first + (rows - 1) / 2.0, seen_late);
            if (!std::isfinite(clock.begin)) return kNoBurst;
        }
        return kRead;
    }

    void modulate(const uint8_t* bits, int32_t length, Sample* out) const override {
        Scratch& s = prepared();
        const Told sent{0, length};
        const Constellation& points = rates_[0].points;
        const int frame_bits = lengths_.bits(length), count = symbols(sent);
        const uint8_t* header = &headers_[static_cast<size_t>(lengths_.row(length)) * kWordBits];
        int taken = 0;
        for (int symbol = 0; symbol < count; symbol++, out += symbol_) {
            Sample* grid = s.first.data();
            std::fill_n(grid, p_.size, Sample());
            const Sample* word = symbol < 2 ? &words_[symbol * used_] : known_.data();
            for (int c = 0; c < used_; c++) grid[bins_[c]] = word[c];
            for (int d = 0; symbol >= 2 && d < p_.data_count; d++) {
                Sample& at = grid[bins_[d]];
                if (symbol == 2) at = (d < kWordBits ? header[d] : 0) ^ header_mask_[d] ? 1.0f : -1.0f;
                else if (taken < frame_bits) {
                    int value = 0;
                    for (int bit = 0; bit < points.bits() && taken < frame_bits; bit++) value |= bits[taken++] << bit;
                    at = points.point(value);
                }
            }
            // The inverse of a spectrum is the conjugate of the forward FFT of its conjugate.
            for (int k = 0; k < p_.size; k++) grid[k] = std::conj(grid[k]);
            fft_.run(grid, s.spare.data());
            for (int k = 0; k < p_.size; k++) out[p_.prefix + k] = std::conj(grid[k]);
            std::copy_n(out + p_.size, p_.prefix, out);
        }
    }

   private:
    // The used carriers with those of data first, in order: then what is done for each of them needs no index. They are
    // filled up to a multiple of `kLanes` by carriers on which nothing is sent.
    void arrange(const OfdmParameters& p) {
        std::vector<int32_t> order = copied(p.data, p_.data_count), place(used_);
        for (int c = 0; c < used_; c++)
            if (std::find(order.begin(), order.end(), c) == order.end()) order.push_back(c);
        for (int k = 0; k < used_; k++) place[order[k]] = k;
        const auto sort = [&](auto& values) {
            auto before = values;
            for (size_t k = 0; k < values.size(); k++) values[k] = before[k / used_ * used_ + order[k % used_]];
        };
        sort(carriers_);
        sort(words_);
        sort(known_);
        sort(word_weight_);
        word_weight_.resize(wide_, 1.0f);
        split_words_.resize(static_cast<size_t>(2) * wide_);
        split_known_.resize(wide_);
        for (int c = 0; c < used_; c++) {
            for (int word = 0; word < 2; word++) split_words_.set(word * wide_ + c, words_[word * used_ + c]);
            split_known_.set(c, known_[c]);
        }
        const auto matrix = [&](const Sample* rows) {
            std::vector<Sample> columns(static_cast<size_t>(used_) * used_);
            for (int column = 0; column < used_; column++)
                for (int row = 0; row < used_; row++)
                    columns[column * used_ + row] = rows[order[row] * used_ + order[column]];
            return Matrix(columns, used_, wide_);
        };
        smooth_ = matrix(p.smooth);
        smooth_words_ = matrix(p.smooth_words);
        for (auto* some : {&pilots_, &once_, &twice_})
            for (int& c : *some) c = place[c];
    }

    // How a phase step turns symbols, for steps a part of a turn apart.
    struct Tones {
        int size, reach, wide;
        Split turns;  // symbols by steps

        Tones(int size, double most)
            : size(size),
              reach(static_cast<int>(size * most / kTau)),
              wide((2 * reach + kLanes) / kLanes * kLanes),
              turns(static_cast<size_t>(size / kLeastTone) * wide) {
            for (int k = 0; k < size / kLeastTone; k++)
                for (int place = -reach; place <= reach; place++)
                    turns.set(k * wide + place + reach, unit(-kTau * place * k / size));
        }
    };

    // What packets of one MCS are sent with.
    struct Mcs {
        Lengths lengths;
        Constellation points;
    };

    // What a header says.
    struct Told {
        int mcs, length;
    };

    int points_of(Told told) const {
        const Mcs& mcs = rates_[told.mcs];
        return (mcs.lengths.bits(told.length) + mcs.points.bits() - 1) / mcs.points.bits();
    }

    int symbols(Told told) const { return kHead + (points_of(told) + p_.data_count - 1) / p_.data_count; }

    // Read the header with the channel estimate of the sync words, and improve that estimate.
    Told head(Scratch& s, float noise, Clock& clock) const {
        std::copy(word_weight_.begin(), word_weight_.end(), s.weight.begin());
        const Lateness late = decide(s, 2, 1, noise, bpsk_, p_.data_count, 1);
        if (std::abs(late.late) < kFar) clock.after(kHead - 1, late);
        if (lengths_.fixed()) return {0, lengths_.longest()};
        s.header.resize(p_.data_count);
        bpsk_.soft(s.seen, p_.data_count, s.header.data());
        for (int bit = 0; bit < kWordBits; bit++) s.header[bit] = header_mask_[bit] ? -s.header[bit] : s.header[bit];
        return said(s.header.data());
    }

    // MCS and length in a header. Also for headers of GNU Radio's blocks, which count frames and send only the longest.
    Told said(const float* soft) const {
        const int row = counted(soft);
        if (row >= 0) return {0, lengths_.shortest() + row};
        const int likeliest = likeliest_word(signs_.data(), p_.mcs_count * lengths_.count(), soft);
        return {likeliest / lengths_.count(), lengths_.shortest() + likeliest % lengths_.count()};
    }

    // The row of the length in an undamaged header of the longest frame, whose number may count frames; -1 for others.
    int counted(const float* soft) const {
        if (!p_.counted) return -1;
        uint32_t hard = 0;
        for (int bit = 0; bit < kWordBits; bit++) hard |= static_cast<uint32_t>(soft[bit] > 0) << bit;
        const int last = lengths_.count() - 1;
        if (field(hard) == field(own(last)) && hard >> 2 * kFieldBits == crc8(hard)) {
            for (int row = last; row >= 0 && field(own(row)) == field(hard); row--)
                if (own(row) == hard) return row;
            return last;
        }
        return -1;
    }

    static uint32_t field(uint32_t header) { return header & ((1u << kFieldBits) - 1); }

    // The header bits of a length, by its row in the table.
    uint32_t own(int row) const {
        uint32_t bits = 0;
        for (int bit = 0; bit < kWordBits; bit++)
            bits |= static_cast<uint32_t>(headers_[static_cast<size_t>(row) * kWordBits + bit]) << bit;
        return bits;
    }

    // CRC-8 of length and number, each as 16 bits with the lower 8 first: polynomial 0x07, start 0xff.
    static uint32_t crc8(uint32_t header) {
        const uint32_t length = field(header), number = field(header >> kFieldBits);
        uint32_t crc = 0xff;
        for (uint32_t byte : {length & 0xff, length >> 8, number & 0xff, number >> 8}) {
            crc ^= byte;
            for (int bit = 0; bit < 8; bit++) crc = (crc << 1 ^ (crc & 0x80 ? 0x07 : 0)) & 0xff;
        }
        return crc;
    }

    Scratch& prepared() const {
        Scratch& s = scratch();
        for (auto* one : {&s.rotation, &s.first, &s.second, &s.profile, &s.spare}) one->resize(p_.size);
        s.powers_of.resize(half_ + 1);
        const int rows = std::max(p_.chunk, kHead);
        for (auto* one : {&s.rows, &s.model, &s.turns}) one->resize(static_cast<size_t>(rows) * wide_);
        s.energies.resize(static_cast<size_t>(rows) * wide_);
        for (auto* one : {&s.gains, &s.before, &s.sum, &s.step, &s.known, &s.taken}) one->resize(wide_);
        for (auto* one : {&s.weight, &s.total}) one->resize(wide_);
        s.heights.resize(std::max(p_.size, tones_.back().wide));
        s.inverse.resize(p_.data_count);
        s.sharpness.resize(p_.data_count);
        for (auto* one : {&s.tone, &s.straight}) one->resize(rows);
        s.seen.resize(rows * p_.data_count, most_points_);
        return s;
    }

    // Running sums of powers, and of what each sample says of the one half a symbol behind it: in double precision and
    // from the front, so that silence adds exactly nothing.
    void sum_up(const Sample* samples, int64_t count, Scratch& s) const {
        for (auto* one : {&s.products[0], &s.products[1], &s.powers}) one->resize(count + 1);
        double re = 0, im = 0, power = 0;
        double *re_out = s.products[0].data(), *im_out = s.products[1].data(), *power_out = s.powers.data();
        re_out[0] = im_out[0] = power_out[0] = 0;
        for (int64_t k = 0; k < count - half_; k++) {
            const Sample p = mul_conj(samples[k + half_], samples[k]);
            re += static_cast<double>(p.real());
            im += static_cast<double>(p.imag());
            power += static_cast<double>(square(samples[k]));
            re_out[k + 1] = re;
            im_out[k + 1] = im;
            power_out[k + 1] = power;
        }
        for (int64_t k = count - half_; k < count; k++) power_out[k + 1] = power += static_cast<double>(square(samples[k]));
    }

    // `count` samples from a place on, each 1 + `pace` after the one before: gr_ros2/phy/stretch.py.
    void stretch(Samples samples, double first, double pace, int64_t count, std::vector<Sample>& out) const {
        out.resize(count);
        const int taps = p_.weight_count;
        for (int64_t n = 0; n < count; n++) {
            const double at = first + (1 + pace) * static_cast<double>(n), whole = std::floor(at);
            const float* weight = &weights_[std::llrint((at - whole) * p_.fractions) * taps];
            const int64_t base = static_cast<int64_t>(whole) - taps / 2 + 1;
            const int64_t low = std::max<int64_t>(0, -base), high = std::min<int64_t>(taps, samples.count - base);
            float re = 0, im = 0;
            for (int64_t tap = low; tap < high; tap++) {
                re += weight[tap] * samples.at[base + tap].real();
                im += weight[tap] * samples.at[base + tap].imag();
            }
            out[n] = {re, im};
        }
    }

    // Look closely at a place where the first half of a symbol is repeated.
    Place placed(Samples samples, int64_t at, Scratch& s) const {
        const Place place = look(samples, at, s);
        if (!place.found || place.pace == 0) return place;
        const double step = 1 + place.pace;
        const int64_t before = 2 * p_.prefix, count = 3 * symbol_ + 2 * p_.prefix;
        at = std::max<int64_t>(0, at);
        stretch(samples, at - before * step, place.pace, count, s.again);
        const Place again = look({s.again.data(), count}, before, s);
        return {at + std::llrint((again.begin - before) * step), again.frequency, again.found, place.pace};
    }

    // The same at the pace of this clock, and how far the burst's own is from it.
    Place look(Samples samples, int64_t at, Scratch& s) const {
        at = std::max<int64_t>(0, at);
        float re = 0, im = 0;
        const int64_t length = std::min<int64_t>(window_, samples.count - half_ - at);
        for (int64_t k = 0; k < length; k++) {
            const Sample p = mul_conj(samples.at[at + half_ + k], samples.at[at + k]);
            re += p.real();
            im += p.imag();
        }
        double frequency = std::atan2(p_.repeat * im, p_.repeat * re) / half_;
        const int64_t first = at + p_.prefix - back_;
        const int size = p_.size;
        if (samples.count - first < symbol_ + size) return {at, frequency, false};
        Sample *one = s.first.data(), *two = s.second.data(), *profile = s.profile.data();
        Rotation(0, -frequency).fill(s.rotation.data(), size);
        const Sample between = unit(-frequency * symbol_);
        for (int k = 0; k < size; k++) one[k] = mul(samples.at[first + k], s.rotation[k]);
        for (int k = 0; k < size; k++) two[k] = mul(mul(samples.at[first + symbol_ + k], s.rotation[k]), between);
        fft_.run(one, s.spare.data());
        fft_.run(two, s.spare.data());
        for (int k = 0; k < size; k++) profile[k] = mul_conj(two[k], one[k]);
        float highest = -1;
        int delayed = 0, shift = 0;
        for (int row = 0; row < p_.shift_count; row++) {
            for (int delay = 0; delay < p_.delay_count; delay++) {
                const Sample* expected = &turns_[static_cast<size_t>(row) * size];
                const Sample* advance = &advances_[static_cast<size_t>(delay) * size];
                float a = 0, b = 0;
                for (int k = 0; k < size; k++) {
                    const Sample p = mul(mul(expected[k], advance[k]), profile[k]);
                    a += p.real();
                    b += p.imag();
                }
                const float height = a * a + b * b;
                if (height > highest) {
                    highest = height;
                    shift = shifts_[row];
                    delayed = delay;
                }
            }
        }
        if (shift) {
            frequency += kTau * shift / size;
            const int left = (shift % size + size) % size;
            std::rotate(one, one + left, one + size);
            std::rotate(two, two + left, two + size);
            const Sample rest = unit(-kTau * shift * symbol_ / size);
            for (int k = 0; k < size; k++) two[k] = mul(two[k], rest);
        }
        float power = 0;
        Sample phases = 0;
        re = im = 0;
        for (int k = 0; k < size; k++) {
            power += square(one[k]) + square(two[k]);
            one[k] = mul(one[k], whole_[k]);
            two[k] = mul(mul(two[k], whole_[size + k]), advances_[static_cast<size_t>(delayed) * size + k]);
            const Sample p = mul_conj(two[k], one[k]);
            re += p.real();
            im += p.imag();
            if (whole_[k] != Sample()) phases += p / (std::sqrt(square(p)) + static_cast<float>(kTiny));
        }
        const double angle = std::atan2(im, re);
        const Sample straight = unit(-angle);
        Place place{0, 0, false};
        pace(one, two, straight, delays_[delayed], place);
        // Of the inverse FFT only the magnitude is wanted: the forward one of the conjugate has it.
        for (int k = 0; k < size; k++) profile[k] = std::conj(one[k] + mul(two[k], straight));
        fft_.run(profile, s.spare.data());
        squares(profile, size, s.heights.data());
        int peak = argmax(s.heights.data(), size);
        const double alike = s.heights[peak] / std::max(static_cast<double>(power) * p_.energy, kTiny);
        bool found = alike > p_.alike;
        if (!found) {
            // The phases alone, so that a tone does not pass for a burst.
            found = std::abs(phases) > p_.together * p_.even_count;
            // The prefix begins with the paths that together hold the most.
            double sum = 0, most = -1;
            for (int k = 0; k < p_.prefix; k++) sum += s.heights[k];
            for (int k = 0; k < size; k++) {
                if (sum > most) {
                    most = sum;
                    peak = k + back_;
                }
                sum += static_cast<double>(s.heights[(k + p_.prefix) % size]) - s.heights[k];
            }
        }
        const int late = (peak + half_) % size - half_;
        place.begin = first - p_.prefix + late;
        place.frequency = frequency + angle / symbol_;
        place.found = found && std::isfinite(power);
        return place;
    }

    // How much further apart the samples of a burst are, from the delay of its second sync word.
    void pace(const Sample* one, const Sample* two, Sample straight, double delay, Place& place) const {
        double top = 0, bottom = 0, noise = 0;
        const auto each = [&](auto use) {
            for (int k = 0; k < p_.size; k++) {
                if (whole_[k] == Sample()) continue;
                const Sample p = mul(mul_conj(two[k], one[k]), straight);
                use(kTau / p_.size * (k < half_ ? k : k - p_.size), std::abs(static_cast<double>(p.real())), p.imag());
            }
        };
        each([&](double turn, double real, double imag) {
            top += turn * imag;
            bottom += turn * turn * real;
        });
        bottom = std::max(bottom, kTiny);
        const double slope = top / bottom;
        each([&](double turn, double real, double imag) {
            const double rest = turn * (imag - slope * turn * real);
            noise += rest * rest;
        });
        if (!(std::abs(slope) < p_.delay_step)) return;
        place.delay = delay - slope;
        place.variance = noise / (bottom * bottom) + p_.unsteady;
        const bool sure = place.delay * place.delay > p_.sure * p_.sure * place.variance;
        place.pace = sure ? place.delay / symbol_ : 0;
    }

    // Used carriers of some of a burst's symbols, into `rows`.
    void spectra(Samples samples, Clock clock, double frequency, int symbol, int count, Scratch& s) const {
        const int64_t base = std::llrint(clock.begin + clock.pace * symbol);
        const int64_t first = std::max<int64_t>(0, base + static_cast<int64_t>(symbol) * symbol_ + p_.prefix - back_);
        Rotation(0, -frequency).fill(s.rotation.data(), p_.size);
        Rotation(-frequency * static_cast<double>(first), -frequency * symbol_).fill(s.straight.data(), count);
        const float scale = 1.0f / p_.size;
        advance(clock.begin + clock.pace * symbol - static_cast<double>(base), s, s.step);
        advance(clock.pace, s, s.known);
        for (int row = 0; row < count; row++) {
            const int64_t at = first + static_cast<int64_t>(row) * symbol_;
            const int have = static_cast<int>(std::max<int64_t>(0, std::min<int64_t>(p_.size, samples.count - at)));
            Sample* body = s.first.data();
            products(samples.at + at, s.rotation.data(), have, body);
            std::fill(body + have, body + p_.size, Sample());
            const Sample* found = fft_.result(body, s.spare.data());
            const Sample start = s.straight[row] * scale;
            for (int c = 0; c < wide_; c++) s.taken.set(c, found[bins_[c]]);
            for (int c = 0; c < wide_; c += kLanes) {
                const Group step = s.step.group(c);
                s.rows.set(row * wide_ + c, s.taken.group(c).times(step.times(start)));
                s.step.set(c, step.times(s.known.group(c)));
            }
        }
    }

    // What brings carriers forward by a fraction of a sample, or some.
    void advance(double samples, Scratch& s, Split& out) const {
        Rotation(0, kTau / p_.size * samples).fill(s.powers_of.data(), half_ + 1);
        for (int c = 0; c < used_; c++) {
            const Sample turned = s.powers_of[std::abs(carriers_[c])];
            out.re[c] = turned.real();
            out.im[c] = carriers_[c] < 0 ? -turned.imag() : turned.imag();
        }
        std::fill(out.re.begin() + used_, out.re.end(), 0.0f);
        std::fill(out.im.begin() + used_, out.im.end(), 0.0f);
    }

    // Channel from both sync words, into `gains`; returns the noise on each carrier.
    float first_estimate(Scratch& s) const {
        for (int c = 0; c < wide_; c += kLanes) {
            Group both = s.rows.group(c).times_conj(split_words_.group(c));
            both.add(s.rows.group(wide_ + c).times_conj(split_words_.group(wide_ + c)));
            s.sum.set(c, both);
        }
        smooth_words_.times(s.sum, s.gains);
        double noise = 0;
        for (int k = 0; k < 2 * wide_; k += kLanes) {
            const Group expected = s.gains.group(k % wide_).times(split_words_.group(k)), seen = s.rows.group(k);
            const Lanes re = seen.re - expected.re, im = seen.im - expected.im;
            noise += sum(re * re + im * im);
        }
        return static_cast<float>(std::max(noise / p_.degrees, kTiny));
    }

    // Mean power of a burst over that of the noise in the sampled band, from both sync words.
    double signal_to_noise(const Scratch& s) const {
        double re = 0, im = 0, own = 0, empty = 0, all = 0;
        for (int k = 0; k < p_.twice_count; k++) {
            const Sample a = mul(s.rows.at(twice_[k]), crosswise_[k]);
            const Sample b = mul(s.rows.at(wide_ + twice_[k]), crosswise_[p_.twice_count + k]);
            const Sample p = mul_conj(b, a);
            re += p.real();
            im += p.imag();
            own += square(a) + square(b);
        }
        for (int c : once_) empty += square(s.rows.at(c));
        for (int k = 0; k < 2 * wide_; k++) all += square(s.rows.at(k));
        const double differ = own - 2 * std::sqrt(re * re + im * im);
        const double noise = std::max(empty + differ / p_.pair_weight, kTiny) / (used_ - 0.5);
        return (all - 2 * used_ * noise) * p_.power / (p_.word_weight_sum * noise * p_.size);
    }

    // Symbols (rows from `row` on) to likelihoods of points, with a channel estimate that they have made better; returns
    // by how many samples they came late.
    Lateness decide(Scratch& s, int row, int count, float noise, const Constellation& points, int used, int rounds) const {
        const int from = row * wide_, end = from + count * wide_;
        s.before = s.gains;
        for (int i = 0, at = from; at < end; i++, at += wide_) {
            Sample all;
            for (int c : pilots_) all += mul_conj(s.rows.at(at + c), mul(s.gains.at(c), known_[c]));
            s.tone[i] = all;
        }
        tone(s, count);
        for (int i = 0, at = from; at < end; i++, at += wide_)
            for (int c = 0; c < wide_; c += kLanes) s.rows.set(at + c, s.rows.group(at + c).times(s.straight[i]));
        double late = 0, firm = kTiny;
        for (int round = 0; round < rounds; round++) {
            weigh(s, from, noise, points, used);
            points.expect(s.seen, used);
            double certain = 0, all = 0;
            model(s, count, used, &certain, &all);
            for (int i = 0, at = 0; i < count; i++, at += wide_) {
                Group turned = {};
                for (int c = 0; c < wide_; c += kLanes) {
                    const Group expected = s.gains.group(c).times(s.model.group(at + c));
                    const Group turn = s.rows.group(from + at + c).times_conj(expected);
                    s.turns.set(at + c, turn);
                    turned.add(turn);
                }
                s.tone[i] = {sum(turned.re), sum(turned.im)};
            }
            tone(s, count);
            const double more = lateness(s, count, &firm);
            late += more;
            advance(more, s, s.step);
            for (int c = 0; c < wide_; c += kLanes) {
                const Lanes weight = lanes(&s.weight[c]), most = Lanes{} + static_cast<float>(p_.memory);
                Lanes total = weight < most ? weight : most;
                const Group before = s.before.group(c), step = s.step.group(c);
                Group all_seen = {before.re * total, before.im * total};
                for (int i = 0, at = c; i < count; i++, at += wide_) {
                    const Group seen = s.rows.group(from + at).times(step.times(s.straight[i]));
                    s.rows.set(from + at, seen);
                    all_seen.add(seen.times_conj(s.model.group(at)));
                    total += lanes(&s.energies[at]);
                }
                s.sum.set(c, Group{all_seen.re / total, all_seen.im / total});
                put(total, &s.total[c]);
            }
            smooth_.times(s.sum, s.gains);
            if (certain > (1 - p_.doubt) * all) break;
        }
        std::swap(s.weight, s.total);
        weigh(s, from, noise, points, used);
        return {late, noise / (2 * firm) + p_.unsteady};
    }

    // What was sent, as far as is known: pilots, and what the points that were received are expected to be.
    void model(Scratch& s, int count, int used, double* certain, double* all) const {
        for (int i = 0; i < count; i++) {
            const int at = i * wide_, first = i * p_.data_count, here = std::max(0, std::min(p_.data_count, used - first));
            float squares = 0, powers = 0;
            const auto put_data = [&](const std::vector<float>& means, std::vector<float>& out) {
                std::copy_n(&means[first], here, &out[at]);
                std::fill_n(&out[at + here], p_.data_count - here, 0.0f);
                for (int d = 0; d < here; d++) squares += means[first + d] * means[first + d];
            };
            put_data(s.seen.means[0], s.model.re);
            put_data(s.seen.means[1], s.model.im);
            const float *one = &s.seen.squares[0][first], *other = &s.seen.squares[1][first];
            float* __restrict energies = &s.energies[at];
            for (int d = 0; d < here; d++) {
                energies[d] = one[d] + other[d];
                powers += energies[d];
            }
            std::fill(energies + here, energies + p_.data_count, 0.0f);
            for (int c = p_.data_count; c < wide_; c++) {
                s.model.set(at + c, split_known_.at(c));
                energies[c] = 1;
            }
            *certain += squares;
            *all += powers;
        }
    }

    // Points as received, and how sharp each is.
    void weigh(Scratch& s, int at, float noise, const Constellation& points, int used) const {
        const float sharpest = kSmallestNoise * points.power(), *gains_re = s.gains.re.data(), *gains_im = s.gains.im.data();
        float *__restrict by_re = s.inverse.re.data(), *__restrict by_im = s.inverse.im.data();
        float* __restrict sharpness = s.sharpness.data();
        for (int d = 0; d < p_.data_count; d++) {
            const float inverse = 1.0f / (gains_re[d] * gains_re[d] + gains_im[d] * gains_im[d] + static_cast<float>(kTiny));
            by_re[d] = gains_re[d] * inverse;
            by_im[d] = -gains_im[d] * inverse;
            sharpness[d] = 1.0f / std::max(noise * inverse, sharpest);
        }
        for (int first = 0; first < used; first += p_.data_count, at += wide_) {
            const float *rows_re = &s.rows.re[at], *rows_im = &s.rows.im[at];
            const int here = std::min(p_.data_count, used - first);
            float *__restrict real = &s.seen.parts[0][first], *__restrict imag = &s.seen.parts[1][first];
            for (int d = 0; d < here; d++) {
                real[d] = rows_re[d] * by_re[d] - rows_im[d] * by_im[d];
                imag[d] = rows_re[d] * by_im[d] + rows_im[d] * by_re[d];
            }
            std::copy_n(s.sharpness.begin(), here, &s.seen.sharpness[first]);
        }
        points.weigh(s.seen, used);
    }

    // What straightens symbols of which each is turned further than the one before by the same angle: from `tone` into
    // `straight`.
    void tone(Scratch& s, int count) const {
        int row = 0;
        while (1 << row < count) row++;
        const Tones& tones = tones_[row];
        const int reach = tones.reach, size = tones.size;
        float* const heights = s.heights.data();
        for (int place = 0; place < tones.wide; place += kLanes) {
            Group all = {};
            for (int k = 0; k < count; k++) all.add(tones.turns.group(k * tones.wide + place).times(s.tone[k]));
            put(all.re * all.re + all.im * all.im, heights + place);
        }
        for (int place = 0; place < 2 * reach + 1; place++) heights[place] = std::sqrt(heights[place]);
        const int best = argmax(heights, 2 * reach + 1);
        double exact = best - reach;
        if (best > 0 && best < 2 * reach) {
            const double before = heights[best - 1], at = heights[best], after = heights[best + 1];
            const double bend = before - 2 * at + after;
            if (bend < 0) exact += 0.5 * (before - after) / bend;
        }
        Rotation(0, -kTau * exact / size).fill(s.straight.data(), count);
        double re = 0, im = 0;
        for (int k = 0; k < count; k++) {
            const Sample p = mul(s.tone[k], s.straight[k]);
            re += p.real();
            im += p.imag();
        }
        const Sample back = unit(-std::atan2(im, re));
        for (int k = 0; k < count; k++) s.straight[k] = mul(s.straight[k], back);
    }

    // Samples by which symbols come late, from by how little their carriers are turned.
    double lateness(Scratch& s, int count, double* firm) const {
        double top = 0, bottom = 0;
        for (int c = 0; c < wide_; c += kLanes) {
            Group all = {};
            for (int i = 0; i < count; i++) all.add(s.turns.group(i * wide_ + c).times(s.straight[i]));
            for (int k = 0; k < kLanes; k++) {
                const double place = places_[c + k];
                top += place * all.im[k];
                bottom += place * place * std::abs(all.re[k]);
            }
        }
        *firm = std::max(bottom, kTiny);
        return -top / *firm;
    }

    OfdmParameters p_;  // its numbers; arrays are copied below
    Lengths lengths_;   // of the first MCS
    int symbol_, half_, window_, back_, used_, wide_, most_points_ = 0, longest_ = 0;
    std::vector<int32_t> carriers_, pilots_, once_, twice_, shifts_, bins_;
    std::vector<Sample> words_, known_, turns_, whole_, crosswise_, advances_;
    Split split_words_, split_known_;  // with the carriers that fill up
    Matrix smooth_, smooth_words_;
    std::vector<double> places_;       // phase by which a sample turns each carrier
    std::vector<Tones> tones_;         // for 1, 2, 4, ... symbols
    std::vector<uint8_t> headers_, header_mask_;
    std::vector<float> signs_;
    std::vector<float> word_weight_, delays_, weights_;
    std::vector<Mcs> rates_;
    Constellation bpsk_;
    Fft fft_;
};

}  // namespace

std::unique_ptr<Modem> make_ofdm(const OfdmParameters& given) { return std::make_unique<Ofdm>(given); }

}  // namespace gr_ros2
