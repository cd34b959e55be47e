// A SoapySDR device without hardware: what is written comes back, at the sample rate, with noise before and between.
// It writes what it is told into a log, one line a call: `driver=loopback,log=FILE`. With `rate=N` it runs at that
// rate whatever is asked for, with `dies=S` it falls silent after S seconds, with `refuses=N` it takes no samples after N
// bursts. With `tells=N` it reports each burst sent, and of each Nth an underflow, a late one and a damaged one. With
// `loses=N` it reports N times that samples received were lost. With `tuned=HZ` it is tuned there whatever is asked for,
// its gain stays below `most=DB`, and what `breaks=` names fails: `rate` or `start`, of the transmitter. With `clock=S` it
// has a clock, which says S seconds when the device is opened: it tags what it gives, and sends at a time.
#include <SoapySDR/Device.hpp>
#include <SoapySDR/Errors.hpp>
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
#include <stdexcept>
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
        if (args.count("refuses"))
            takes_ = std::atol(args.at("refuses").c_str());
        if (args.count("tells"))
            tells_ = std::atol(args.at("tells").c_str());
        if (args.count("loses"))
            loses_ = std::atol(args.at("loses").c_str());
        if (args.count("tuned"))
            tuned_ = std::atof(args.at("tuned").c_str());
        if (args.count("most"))
            most_ = std::atof(args.at("most").c_str());
        if (args.count("clock"))
            clock_ = std::atof(args.at("clock").c_str());
        if (args.count("breaks"))
            breaks_ = args.at("breaks");
    }
    ~Loopback() override { say(SOAPY_SDR_TX, "closed"); }

    bool hasHardwareTime(const std::string&) const override { return clock_ >= 0; }
    long long getHardwareTime(const std::string&) const override { return at(Clock::now()); }

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
        gains_[direction] = std::min(value, most_);
        say(direction, "gain " + std::to_string(value));
    }
    double getGain(const int direction, const size_t, const std::string&) const override { return gains_[direction]; }
    SoapySDR::Range getGainRange(const int, const size_t, const std::string&) const override
    {
        return SoapySDR::Range(0, 60);
    }

    std::vector<std::string> listFrequencies(const int, const size_t) const override { return { "RF" }; }
    void setFrequency(const int direction, const size_t, const std::string&, const double value,
                      const SoapySDR::Kwargs&) override
    {
        frequencies_[direction] = tuned_ > 0 ? tuned_ : value;
        say(direction, "frequency " + std::to_string(value));
    }
    double getFrequency(const int direction, const size_t, const std::string&) const override
    {
        return frequencies_[direction];
    }
    SoapySDR::RangeList getFrequencyRange(const int, const size_t, const std::string&) const override
    {
        return { SoapySDR::Range(1e6, 6e9) };
    }

    void setSampleRate(const int direction, const size_t, const double rate) override
    {
        if (direction == SOAPY_SDR_TX && breaks_ == "rate")
            throw std::runtime_error("no such rate");
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
        } else if (breaks_ == "start") {
            return SOAPY_SDR_STREAM_ERROR;
        }
        return 0;
    }
    int deactivateStream(SoapySDR::Stream*, const int, const long long) override { return 0; }

    int writeStream(SoapySDR::Stream*, const void* const* buffers, const size_t count, int& flags, const long long when,
                    const long timeout) override
    {
        if (written_ == takes_) {
            std::this_thread::sleep_for(std::chrono::microseconds(timeout));
            return SOAPY_SDR_TIMEOUT;
        }
        written_++;
        const auto* samples = static_cast<const Sample*>(buffers[0]);
        float peak = 0;
        for (size_t i = 0; i < count; i++)
            peak = std::max(peak, std::abs(samples[i]));
        {
            std::lock_guard<std::mutex> hold(lock_);
            if (clock_ >= 0 && (flags & SOAPY_SDR_HAS_TIME)) {
                // Zeros up to the sample that is on the air then.
                const auto first = static_cast<long long>((when - at(began_)) * 1e-9 * rate_ + 0.5);
                const auto coming = given_ + static_cast<long long>(air_.size());
                if (first < coming)
                    events_.push_back(SOAPY_SDR_TIME_ERROR);
                else
                    air_.insert(air_.end(), first - coming, Sample());
            }
            air_.insert(air_.end(), samples, samples + count);
            if (tells_ > 0) {
                if (written_ % tells_ == 0)
                    events_.insert(events_.end(), { SOAPY_SDR_UNDERFLOW, SOAPY_SDR_TIME_ERROR, SOAPY_SDR_CORRUPTION });
                events_.push_back(0);
            }
        }
        say(SOAPY_SDR_TX, "write " + std::to_string(count) + (flags & SOAPY_SDR_END_BURST ? " end " : " more ") +
                              std::to_string(peak));
        return static_cast<int>(count);
    }

    int readStreamStatus(SoapySDR::Stream*, size_t&, int& flags, long long&, const long) override
    {
        if (tells_ == 0)
            return SOAPY_SDR_NOT_SUPPORTED;
        std::lock_guard<std::mutex> hold(lock_);
        if (events_.empty())
            return SOAPY_SDR_TIMEOUT;
        const int event = events_.front();
        events_.pop_front();
        flags = event == 0 ? SOAPY_SDR_END_BURST : 0;
        return event;
    }

    int readStream(SoapySDR::Stream*, void* const* buffers, const size_t most, int& flags, long long& when,
                   const long) override
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
        if (given_ > 0 && lost_ < loses_ && !losing_) {
            lost_++;
            losing_ = true;
            return SOAPY_SDR_OVERFLOW;
        }
        losing_ = false;
        if (clock_ >= 0) {
            flags |= SOAPY_SDR_HAS_TIME;
            when = at(began_) + static_cast<long long>(given_ / rate_ * 1e9 + 0.5);
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
    // The device's clock, ns.
    long long at(const Clock::time_point when) const
    {
        return static_cast<long long>((clock_ + std::chrono::duration<double>(when - opened_).count()) * 1e9);
    }

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
    std::deque<int> events_;
    std::mt19937 random_{ 1 };
    std::normal_distribution<float> noise_{ 0, 0.002f };
    double rate_ = 1e6, fixed_ = 0, dies_ = 1e9, tuned_ = 0, most_ = 1e9;
    double gains_[2] = {}, frequencies_[2] = {};
    std::string breaks_;
    long long given_ = 0;
    long written_ = 0, takes_ = -1, tells_ = 0, loses_ = 0, lost_ = 0;
    bool losing_ = false;
    double clock_ = -1;
    const Clock::time_point opened_ = Clock::now();
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
