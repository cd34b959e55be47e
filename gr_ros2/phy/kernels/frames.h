// The bytes of plain frames, and the bits that are sent for them: class Frames of gr_ros2/phy/burst.py.

#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

namespace gr_ros2 {

constexpr int kCrcLen = 4;
constexpr int kByteBits = 8;

// CRC-32 (IEEE 802.3), four bytes at a time.
class Crc32 {
   public:
    Crc32() {
        for (uint32_t byte = 0; byte < 256; byte++) {
            uint32_t crc = byte;
            for (int bit = 0; bit < kByteBits; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xedb88320u : 0u);
            tables_[0][byte] = crc;
        }
        for (int table = 1; table < 4; table++)
            for (int byte = 0; byte < 256; byte++) tables_[table][byte] = one_more_zero(tables_[table - 1][byte]);
    }

    uint32_t of(const uint8_t* data, int count) const {
        uint32_t crc = 0xffffffffu;
        int k = 0;
        for (; k + 4 <= count; k += 4) {
            crc ^= data[k] | data[k + 1] << 8 | data[k + 2] << 16 | static_cast<uint32_t>(data[k + 3]) << 24;
            crc = tables_[3][crc & 0xff] ^ tables_[2][crc >> 8 & 0xff] ^ tables_[1][crc >> 16 & 0xff] ^ tables_[0][crc >> 24];
        }
        for (; k < count; k++) crc = one_more_zero(crc ^ data[k]);
        return ~crc;
    }

   private:
    uint32_t one_more_zero(uint32_t crc) const { return tables_[0][crc & 0xff] ^ crc >> 8; }

    std::array<std::array<uint32_t, 256>, 4> tables_;
};

inline const Crc32& crc32() {
    static const Crc32 made;
    return made;
}

// How frames are made, the same for every packet length. `kernels/modem.py` has the same fields.
struct FrameForm {
    int32_t multiple;       // a frame's bytes are filled up with zeros to a multiple of this
    int32_t high_first;     // whether a byte's highest or lowest bit is sent first
    const uint8_t* mask;    // whitening sequence of the longest frame; null where there is more to a frame: Python makes it

    bool plain() const { return mask; }

    // Bytes of the frame of a packet.
    int bytes(int length) const {
        const int least = length + kCrcLen;
        return (least + multiple - 1) / multiple * multiple;
    }

    // The bits of a packet's frame, one per byte, in the order in which they are sent; valid until the thread's next call.
    const uint8_t* wrap(const uint8_t* packet, int length) const {
        static thread_local std::vector<uint8_t> frame, bits;
        const int count = bytes(length), filled = count - kCrcLen;
        frame.assign(packet, packet + length);
        frame.resize(count);
        const uint32_t crc = crc32().of(frame.data(), filled);
        for (int k = 0; k < kCrcLen; k++) frame[filled + k] = static_cast<uint8_t>(crc >> kByteBits * k);
        bits.resize(static_cast<size_t>(count) * kByteBits);
        uint8_t* out = bits.data();
        for (int k = 0; k < count; k++, out += kByteBits) {
            const int byte = frame[k] ^ mask[k];
            for (int bit = 0; bit < kByteBits; bit++) out[bit] = byte >> place(bit) & 1;
        }
        return bits.data();
    }

    // The packet of these soft bits; false if the CRC-32 does not match.
    bool unwrap(const float* soft, int length, uint8_t* packet) const {
        static thread_local std::vector<uint8_t> frame, bits;
        const int count = bytes(length), filled = count - kCrcLen;
        frame.resize(count);
        bits.resize(static_cast<size_t>(count) * kByteBits);
        uint8_t* one = bits.data();
        for (int k = 0; k < count * kByteBits; k++) one[k] = soft[k] > 0;
        for (int k = 0; k < count; k++, one += kByteBits) {
            int byte = 0;
            for (int bit = 0; bit < kByteBits; bit++) byte |= one[bit] << place(bit);
            frame[k] = static_cast<uint8_t>(byte ^ mask[k]);
        }
        uint32_t crc = 0;
        for (int k = 0; k < kCrcLen; k++) crc |= static_cast<uint32_t>(frame[filled + k]) << kByteBits * k;
        if (crc != crc32().of(frame.data(), filled)) return false;
        std::copy_n(frame.begin(), length, packet);
        return true;
    }

   private:
    int place(int bit) const { return high_first ? kByteBits - 1 - bit : bit; }
};

}  // namespace gr_ros2
