// Several bursts in one call: packets to samples, and samples to packets (`BurstModem.take` of gr_ros2/phy/burst.py).
//
// Each call from Python ends with a wait for the interpreter's lock, which costs more than a short burst.

#pragma once

#include "frames.h"
#include "modem.h"

namespace gr_ros2 {

// A receiver's samples and its place in them, and what was found. `kernels/modem.py` has the same fields.
struct Stream {
    const Sample* samples;
    int64_t count;
    const FrameForm* frames;
    int64_t margin, span, peak, burst, stretch;  // constants of the modem
    int64_t cursor, start, last;         // the place; kNone where Python has None
    int64_t room;                         // number of packets for which there is room
    uint8_t* packets;                     // their bytes, one packet after the other
    int32_t* lengths;
    double* snrs;
    int64_t* ends;     // index after the last sample of each packet's burst
    float* soft;       // of the newest burst
    Sample* points;    // two rows: the newest whole packet's, and one to read into
    int64_t row_size;
    int64_t row;       // that of the newest burst if Python unwraps it, otherwise that of the newest whole packet
    int64_t whole, damaged;
    Report report;     // of the newest burst
    int64_t row_points;  // number of points of the newest whole packet
};

enum class Taken { kNeedsSamples, kFull, kNotPlain };

// Index of the first sample in or near the burst that is no finite number; otherwise that after the last sample.
inline int64_t usable(const Stream& s) {
    constexpr float huge = 1e15f;
    const int64_t first = std::max<int64_t>(0, s.start - s.margin), end = std::min(s.start + s.burst + s.margin, s.count);
    float sum = 0;
    for (int64_t k = first; k < end; k++) sum += square(s.samples[k]);
    if (std::isfinite(sum)) return s.count;
    for (int64_t k = first; k < end; k++)
        if (!(std::abs(s.samples[k]) < huge)) return k;
    return first;
}

// Packets until more samples are needed, there is no room, or a burst was read whose frame Python unwraps.
inline Taken take(const Modem& modem, Stream& s) {
    const FrameForm& frames = *s.frames;
    uint8_t* packet = s.packets;
    while (true) {
        if (s.start == kNone) {
            const int64_t first = std::min(s.cursor, s.count);
            const Search found = modem.find({s.samples + first, std::min(s.count - first, s.stretch)});
            if (found.start != kNone) s.start = s.cursor + found.start;
            s.cursor += found.searched;
            if (found.start == kNone && found.searched) continue;
        }
        if (s.start == kNone || s.count - s.start < s.span) return Taken::kNeedsSamples;
        if (s.last != kNone && s.count < s.last) return Taken::kNeedsSamples;
        if (s.whole == s.room) return Taken::kFull;
        const int64_t row = 1 - s.row, count = usable(s);
        Result result = kNoBurst;
        if (count - s.start >= s.span)
            result = modem.read({s.samples, count}, s.start, s.soft, s.points + row * s.row_size, &s.report);
        if (result == kCut && s.report.end > s.count) {
            s.last = s.report.end;
            return Taken::kNeedsSamples;
        }
        if (result == kRead && !frames.plain()) {
            s.row = row;
            return Taken::kNotPlain;
        }
        const bool good = result == kRead && frames.unwrap(s.soft, static_cast<int>(s.report.length), packet);
        if (good) {
            packet += s.report.length;
            s.lengths[s.whole] = static_cast<int32_t>(s.report.length);
            s.snrs[s.whole] = s.report.snr;
            s.ends[s.whole] = s.report.end;
            s.whole++;
            s.row = row;
            s.row_points = s.report.points;
        } else {
            s.damaged++;
        }
        s.cursor = good ? s.report.end - s.margin : s.start + s.peak;
        s.start = s.last = kNone;
    }
}

// Packets to be sent. `kernels/modem.py` has the same fields.
struct Batch {
    const FrameForm* frames;
    int64_t count, gap;        // packets, and zero samples after each
    const uint8_t* data;       // the packets' bytes, or the bits of frames that are not plain, one after the other
    const int32_t* lengths;    // bytes of each packet
    const int32_t* data_sizes;  // bytes in `data` of each packet
    const int64_t* sizes;      // samples of each packet, gap included
    Sample* out;
};

// The bursts of packets, one after the other.
inline void modulate(const Modem& modem, const Batch& b) {
    const uint8_t* data = b.data;
    Sample* out = b.out;
    for (int64_t k = 0; k < b.count; k++) {
        const uint8_t* bits = b.frames->plain() ? b.frames->wrap(data, b.lengths[k]) : data;
        modem.modulate(bits, b.lengths[k], out);
        data += b.data_sizes[k];
        out += b.sizes[k];
        std::fill_n(out - b.gap, b.gap, Sample());
    }
}

}  // namespace gr_ros2
