// The kernels without Python: one modem from a file, its search and reading of samples to standard output. For other
// architectures, where an emulator runs this and nothing else.
//
// File: kind, bytes of numbers, number of arrays, samples, soft bits, points (int64 each); numbers; each array as its
// bytes (int64) and itself; samples. Output: searched, start, read (int64), the report, soft
// bits, points.

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <vector>

extern "C" {
const char* kernels_target();
void* modem_new(int, const void*, int64_t);
void modem_free(void*);
int64_t modem_find(const void*, const void*, int64_t, int64_t*);
int modem_read(const void*, const void*, int64_t, int64_t, float*, void*, void*);
}

// That of modem.h.
struct Report {
    double snr;
    int64_t end, length, soft, points, mcs;
};

static std::vector<char> taken(FILE* file, int64_t bytes) {
    std::vector<char> data(bytes);
    if (std::fread(data.data(), 1, bytes, file) != static_cast<size_t>(bytes)) std::exit(2);
    return data;
}

static int64_t number(FILE* file) {
    int64_t value;
    if (std::fread(&value, sizeof value, 1, file) != 1) std::exit(2);
    return value;
}

int main(int count, char** arguments) {
    if (count == 1) {
        std::puts(kernels_target());
        return 0;
    }
    FILE* file = std::fopen(arguments[1], "rb");
    if (!file) return 2;
    const int64_t kind = number(file), numbers = number(file), arrays = number(file), samples = number(file);
    const int64_t soft_bits = number(file), points = number(file);
    std::vector<char> parameters = taken(file, numbers);
    std::vector<std::vector<char>> kept;
    for (int64_t k = 0; k < arrays; k++) {
        kept.push_back(taken(file, number(file)));
        const char* at = kept.back().data();
        parameters.insert(parameters.end(), reinterpret_cast<char*>(&at), reinterpret_cast<char*>(&at) + sizeof at);
    }
    const std::vector<char> stream = taken(file, 8 * samples);
    void* modem = modem_new(static_cast<int>(kind), parameters.data(), static_cast<int64_t>(parameters.size()));
    if (!modem) return 3;
    int64_t found[3] = {};
    Report report{};
    std::vector<float> soft(soft_bits), seen(2 * points);
    found[0] = modem_find(modem, stream.data(), samples, &found[1]);
    if (found[1] >= 0) {
        found[2] = modem_read(modem, stream.data(), samples, found[1], soft.data(), seen.data(), &report);
    }
    std::fwrite(found, sizeof found, 1, stdout);
    std::fwrite(&report, sizeof report, 1, stdout);
    std::fwrite(soft.data(), sizeof(float), soft.size(), stdout);
    std::fwrite(seen.data(), sizeof(float), seen.size(), stdout);
    modem_free(modem);
}
