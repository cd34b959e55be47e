// Fast DDS for the race, as rmw_fastrtps uses it: opaque CDR messages, topics and types by their DDS names. For Fast DDS
// 2 and 3; called from Python (fast.py), one participant in a process.

#include <memory>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>

#include "fastdds_opaque.hpp"

using Taker = void (*)(const unsigned char*, size_t);

namespace {

class Listener : public DataReaderListener {
public:
    explicit Listener(Taker take) : take_(take) {}

    void on_data_available(DataReader* reader) override
    {
        Bytes bytes;
        SampleInfo info;
        while (reader->take_next_sample(&bytes, &info) == OK) {
            if (info.valid_data) {
                take_(bytes.data(), bytes.size());
            }
        }
    }

private:
    Taker take_;
};

struct Network {
    DomainParticipant* participant;
    Publisher* publisher;
    Subscriber* subscriber;
    std::vector<std::unique_ptr<Listener>> listeners;
};

template <typename Qos>
void apply(Qos& qos, bool reliable, bool latched, int depth)
{
    qos.reliability().kind = reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
    qos.durability().kind = latched ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
    qos.history().kind = KEEP_LAST_HISTORY_QOS;
    qos.history().depth = depth;
    qos.endpoint().history_memory_policy = fast::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    qos.data_sharing().off();
}

Topic* topic_of(Network* network, const char* name, const char* type_name)
{
    TypeSupport type(new OpaqueType(type_name));
    type.register_type(network->participant);
    if (auto* found = network->participant->lookup_topicdescription(name)) {
        return static_cast<Topic*>(found);
    }
    return network->participant->create_topic(name, type_name, TOPIC_QOS_DEFAULT);
}

}  // namespace

extern "C" {

// Join a domain with the profiles `race`, `race_writer` and `race_reader` of an XML text; null if that fails.
void* fast_join(int domain, const char* xml)
{
    auto* factory = DomainParticipantFactory::get_instance();
    if (factory->load_XML_profiles_string(xml, std::strlen(xml)) != OK) {
        return nullptr;
    }
    auto* participant = factory->create_participant_with_profile(static_cast<DomainId_t>(domain), "race");
    if (participant == nullptr) {
        return nullptr;
    }
    return new Network{participant, participant->create_publisher(PUBLISHER_QOS_DEFAULT),
                       participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT), {}};
}

void* fast_writer(void* of, const char* topic, const char* type, int reliable, int latched, int depth)
{
    auto* network = static_cast<Network*>(of);
    DataWriterQos qos;
    if (network->publisher->get_datawriter_qos_from_profile("race_writer", qos) != OK) {
        return nullptr;
    }
    apply(qos, reliable != 0, latched != 0, depth);
    return network->publisher->create_datawriter(topic_of(network, topic, type), qos);
}

// `take` is called from a thread of Fast DDS with each message.
void* fast_reader(void* of, const char* topic, const char* type, int reliable, int latched, int depth, Taker take)
{
    auto* network = static_cast<Network*>(of);
    DataReaderQos qos;
    if (network->subscriber->get_datareader_qos_from_profile("race_reader", qos) != OK) {
        return nullptr;
    }
    apply(qos, reliable != 0, latched != 0, depth);
    network->listeners.push_back(std::make_unique<Listener>(take));
    return network->subscriber->create_datareader(topic_of(network, topic, type), qos, network->listeners.back().get());
}

int fast_write(void* writer, const unsigned char* data, size_t length)
{
    Bytes bytes(data, data + length);
    return written(static_cast<DataWriter*>(writer), &bytes) ? 1 : 0;
}

int fast_writer_matched(void* writer)
{
    PublicationMatchedStatus status;
    static_cast<DataWriter*>(writer)->get_publication_matched_status(status);
    return status.current_count;
}

int fast_reader_matched(void* reader)
{
    SubscriptionMatchedStatus status;
    static_cast<DataReader*>(reader)->get_subscription_matched_status(status);
    return status.current_count;
}

void fast_leave(void* of)
{
    auto* network = static_cast<Network*>(of);
    network->participant->delete_contained_entities();
    DomainParticipantFactory::get_instance()->delete_participant(network->participant);
    delete network;
}

}  // extern "C"
