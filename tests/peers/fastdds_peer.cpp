// A peer on an independent DDS (Fast DDS 2.9), speaking as rmw_fastrtps does: opaque CDR messages, ROS 2 names.
//
//     fastdds_peer DOMAIN DDS_TOPIC DDS_TYPE pub|sub RELIABILITY DURABILITY DEPTH [LIFESPAN_MS DEADLINE_MS]
//
// USER_DATA in the environment is that of its endpoint.
//
// Out: `ready`, `matched N` whenever the number of matched endpoints changes, `data HEX` per message received
// (encapsulation header included). In, for pub: one message per line, in hex. End of input ends it.

#include <cstdlib>
#include <iostream>
#include <memory>
#include <mutex>
#include <sstream>
#include <string>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/DataWriterListener.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>

#include "fastdds_opaque.hpp"

#if FAST_DDS_3
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.hpp>
using Duration_t = eprosima::fastdds::dds::Duration_t;
#else
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
using eprosima::fastrtps::Duration_t;
#endif

namespace {

std::mutex output;

void say(const std::string& line)
{
    std::lock_guard<std::mutex> lock(output);
    std::cout << line << std::endl;
}

std::string to_hex(const Bytes& bytes)
{
    static const char digits[] = "0123456789abcdef";
    std::string text;
    text.reserve(2 * bytes.size());
    for (unsigned char byte : bytes) {
        text += digits[byte >> 4];
        text += digits[byte & 15];
    }
    return text;
}

Bytes from_hex(const std::string& text)
{
    Bytes bytes;
    bytes.reserve(text.size() / 2);
    for (size_t i = 0; i + 1 < text.size(); i += 2) {
        bytes.push_back(static_cast<unsigned char>(std::stoi(text.substr(i, 2), nullptr, 16)));
    }
    return bytes;
}

class WriterEvents : public DataWriterListener {
    void on_publication_matched(DataWriter*, const PublicationMatchedStatus& status) override
    {
        say("matched " + std::to_string(status.current_count));
    }
};

class ReaderEvents : public DataReaderListener {
    void on_subscription_matched(DataReader*, const SubscriptionMatchedStatus& status) override
    {
        say("matched " + std::to_string(status.current_count));
    }

    void on_data_available(DataReader* reader) override
    {
        Bytes bytes;
        SampleInfo info;
        while (reader->take_next_sample(&bytes, &info) == OK) {
            if (info.valid_data) {
                say("data " + to_hex(bytes));
            }
        }
    }
};

template <typename EndpointQos>
void apply(EndpointQos& qos, const std::string& reliability, const std::string& durability, int depth)
{
    qos.reliability().kind = reliability == "reliable" ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
    qos.durability().kind = durability == "transient_local" ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
    qos.history().kind = depth == 0 ? KEEP_ALL_HISTORY_QOS : KEEP_LAST_HISTORY_QOS;
    qos.history().depth = depth == 0 ? 1 : depth;
    qos.endpoint().history_memory_policy = fast::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    qos.data_sharing().off();
    if (const char* text = std::getenv("USER_DATA")) {
        qos.user_data().data_vec(std::vector<unsigned char>(text, text + std::strlen(text)));
    }
}

Duration_t milliseconds(const char* text)
{
    return Duration_t(std::stod(text) / 1000.0L);
}

int fail(const std::string& what)
{
    std::cerr << "fastdds_peer: " << what << std::endl;
    return 1;
}

}  // namespace

int main(int argc, char** argv)
{
    if (argc != 8 && argc != 10) {
        return fail("DOMAIN DDS_TOPIC DDS_TYPE pub|sub RELIABILITY DURABILITY DEPTH [LIFESPAN_MS DEADLINE_MS]");
    }
    const std::string topic_name = argv[2], type_name = argv[3], role = argv[4], reliability = argv[5], durability = argv[6];
    const int depth = std::stoi(argv[7]);

    // UDP on the loopback interface and nothing else.
    DomainParticipantQos participant_qos = PARTICIPANT_QOS_DEFAULT;
    auto transport = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    transport->interfaceWhiteList.emplace_back("127.0.0.1");
    participant_qos.transport().user_transports.push_back(transport);
    participant_qos.transport().use_builtin_transports = false;
    participant_qos.name("fastdds_peer");
    auto* factory = DomainParticipantFactory::get_instance();
    auto* participant = factory->create_participant(static_cast<DomainId_t>(std::stoi(argv[1])), participant_qos);
    if (participant == nullptr) {
        return fail("no participant");
    }
    TypeSupport type(new OpaqueType(type_name.c_str()));
    type.register_type(participant);
    auto* topic = participant->create_topic(topic_name, type_name, TOPIC_QOS_DEFAULT);
    if (topic == nullptr) {
        return fail("no topic");
    }

    WriterEvents writer_events;
    ReaderEvents reader_events;
    DataWriter* writer = nullptr;
    if (role == "pub") {
        DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
        apply(qos, reliability, durability, depth);
        qos.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;
        if (argc == 10) {
            qos.lifespan().duration = milliseconds(argv[8]);
            qos.deadline().period = milliseconds(argv[9]);
        }
        writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, qos, &writer_events);
        if (writer == nullptr) {
            return fail("no writer");
        }
    } else {
        DataReaderQos qos = DATAREADER_QOS_DEFAULT;
        apply(qos, reliability, durability, depth);
        auto* reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, qos, &reader_events);
        if (reader == nullptr) {
            return fail("no reader");
        }
    }
    say("ready");
    for (std::string line; std::getline(std::cin, line);) {
        if (writer != nullptr) {
            Bytes bytes = from_hex(line);
            if (!written(writer, &bytes)) {
                return fail("write refused");
            }
        }
    }
    participant->delete_contained_entities();
    factory->delete_participant(participant);
    return 0;
}
