// A SoapySDR device without hardware: what is written comes back, at the sample rate, with noise before and between.
// It writes what it is told into a log, one line a call: `driver=loopback,log=FILE`. With `rate=N` it runs at that
// rate whatever is asked for, with `dies=S` it falls silent after S seconds.
#include <SoapySDR/Device.hpp>
#include <SoapySDR/Formats.hpp>
#include <SoapySDR/Registry.hpp>

#include <algorithm>
#include <chrono>
#include <complex>
#include <cstdlib>
#include <deque>
#include <fstream>
#include <mutex>
#include <random>
#include <string>
#include <thread>
#include <vector>

using Clock = std::chrono::steady_clock;
using Sample = std::complex<float>;

class Loopback : public SoapySDR::Device
{
public:
    explicit Loopback(const SoapySDR::Kwargs& args)
    {
        if (args.count("log"))
            log_.open(args.at("log"), std::ios::app);
        if (args.count("rate"))
            fixed_ = std::atof(args.at("rate").c_str());
        if (args.count("dies"))
            dies_ = std::atof(args.at("dies").c_str());
    }

    std::string getDriverKey() const override { return "loopback"; }
    size_t getNumChannels(const int) const override { return 1; }
    bool getFullDuplex(const int, const size_t) const override { return true; }

    std::vector<std::string> getStreamFormats(const int, const size_t) const override
    {
        return { SOAPY_SDR_CF32 };
    }

    std::vector<std::string> listAntennas(const int, const size_t) const override { return { "LEFT", "RIGHT" }; }
    void setAntenna(const int direction, const size_t, const std::string& name) override
    {
        say(direction, "antenna " + name);
    }

    std::vector<std::string> listGains(const int, const size_t) const override { return { "PA" }; }
    void setGain(const int direction, const size_t, const std::string&, const double value) override
    {
        say(direction, "gain " + std::to_string(value));
    }
    SoapySDR::Range getGainRange(const int, const size_t, const std::string&) const override
    {
        return SoapySDR::Range(0, 60);
    }

    std::vector<std::string> listFrequencies(const int, const size_t) const override { return { "RF" }; }
    void setFrequency(const int direction, const size_t, const std::string&, const double value,
                      const SoapySDR::Kwargs&) override
    {
        say(direction, "frequency " + std::to_string(value));
    }
    SoapySDR::RangeList getFrequencyRange(const int, const size_t, const std::string&) const override
    {
        return { SoapySDR::Range(1e6, 6e9) };
    }

    void setSampleRate(const int direction, const size_t, const double rate) override
    {
        rate_ = fixed_ > 0 ? fixed_ : rate;
        say(direction, "rate " + std::to_string(rate_));
    }
    double getSampleRate(const int, const size_t) const override { return rate_; }
    SoapySDR::RangeList getSampleRateRange(const int, const size_t) const override
    {
        return { SoapySDR::Range(1e3, 50e6) };
    }
    void setBandwidth(const int direction, const size_t, const double value) override
    {
        say(direction, "bandwidth " + std::to_string(value));
    }
    SoapySDR::RangeList getBandwidthRange(const int, const size_t) const override
    {
        return { SoapySDR::Range(1e3, 50e6) };
    }

    SoapySDR::Stream* setupStream(const int direction, const std::string&, const std::vector<size_t>&,
                                  const SoapySDR::Kwargs&) override
    {
        return reinterpret_cast<SoapySDR::Stream*>(direction == SOAPY_SDR_TX ? &sending_ : &receiving_);
    }
    void closeStream(SoapySDR::Stream*) override {}

    int activateStream(SoapySDR::Stream* stream, const int, const long long, const size_t) override
    {
        if (stream == reinterpret_cast<SoapySDR::Stream*>(&receiving_)) {
            began_ = Clock::now();
            given_ = 0;
        }
        return 0;
    }
    int deactivateStream(SoapySDR::Stream*, const int, const long long) override { return 0; }

    int writeStream(SoapySDR::Stream*, const void* const* buffers, const size_t count, int& flags, const long long,
                    const long) override
    {
        const auto* samples = static_cast<const Sample*>(buffers[0]);
        float peak = 0;
        for (size_t i = 0; i < count; i++)
            peak = std::max(peak, std::abs(samples[i]));
        {
            std::lock_guard<std::mutex> hold(lock_);
            air_.insert(air_.end(), samples, samples + count);
        }
        say(SOAPY_SDR_TX, "write " + std::to_string(count) + (flags & SOAPY_SDR_END_BURST ? " end " : " more ") +
                              std::to_string(peak));
        return static_cast<int>(count);
    }

    int readStream(SoapySDR::Stream*, void* const* buffers, const size_t most, int&, long long&, const long) override
    {
        const double elapsed = std::chrono::duration<double>(Clock::now() - began_).count();
        if (elapsed > dies_) {
            std::this_thread::sleep_for(std::chrono::milliseconds(10));
            return SOAPY_SDR_TIMEOUT;
        }
        const auto due = static_cast<long long>(elapsed * rate_) - given_;
        if (due <= 0) {
            std::this_thread::sleep_for(std::chrono::microseconds(500));
            return SOAPY_SDR_TIMEOUT;
        }
        const size_t count = std::min<size_t>(most, due);
        auto* samples = static_cast<Sample*>(buffers[0]);
        std::lock_guard<std::mutex> hold(lock_);
        for (size_t i = 0; i < count; i++) {
            samples[i] = Sample(noise_(random_), noise_(random_));
            if (!air_.empty()) {
                samples[i] += air_.front();
                air_.pop_front();
            }
        }
        given_ += count;
        return static_cast<int>(count);
    }

private:
    void say(const int direction, const std::string& what)
    {
        if (log_.is_open()) {
            std::lock_guard<std::mutex> hold(log_lock_);
            log_ << (direction == SOAPY_SDR_TX ? "tx " : "rx ") << what << std::endl;
        }
    }

    std::ofstream log_;
    std::mutex lock_, log_lock_;
    std::deque<Sample> air_;
    std::mt19937 random_{ 1 };
    std::normal_distribution<float> noise_{ 0, 0.002f };
    double rate_ = 1e6, fixed_ = 0, dies_ = 1e9;
    long long given_ = 0;
    Clock::time_point began_ = Clock::now();
    int sending_ = 0, receiving_ = 0;
};

static SoapySDR::KwargsList find(const SoapySDR::Kwargs& args)
{
    if (!args.count("driver") || args.at("driver") != "loopback")
        return {};
    return { args };
}

static SoapySDR::Device* make(const SoapySDR::Kwargs& args) { return new Loopback(args); }

static SoapySDR::Registry registration("loopback", &find, &make, SOAPY_SDR_ABI_VERSION);
