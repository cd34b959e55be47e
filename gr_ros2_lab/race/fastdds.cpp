// Fast DDS for the race, as rmw_fastrtps uses it: opaque CDR messages, topics and types by their DDS names. For Fast DDS
// 2 and 3; called from Python (fast_network.py), one participant in a process.

#include <cstring>
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
#include <fastdds/dds/topic/TopicDataType.hpp>
#if __has_include(<fastdds/config.hpp>)
#define FAST_DDS_3 1
namespace fast = eprosima::fastdds;
#else
#define FAST_DDS_3 0
namespace fast = eprosima::fastrtps;
#endif

using namespace eprosima::fastdds::dds;
using fast::rtps::InstanceHandle_t;
using fast::rtps::SerializedPayload_t;
using Bytes = std::vector<unsigned char>;
using Taker = void (*)(const unsigned char*, size_t);

namespace {

// A type about which nothing is known but its name: the message is the payload, as it came or as it goes.
class OpaqueType : public TopicDataType {
public:
    explicit OpaqueType(const char* name)
    {
        // The size to begin with: payloads are reallocated, as rmw_fastrtps has it.
#if FAST_DDS_3
        set_name(name);
        max_serialized_type_size = 64;
        is_compute_key_provided = false;
#else
        setName(name);
        m_typeSize = 64;
        m_isGetKeyDefined = false;
        auto_fill_type_object(false);
        auto_fill_type_information(false);
#endif
    }

#if FAST_DDS_3
    bool serialize(const void* const data, SerializedPayload_t& payload, DataRepresentationId_t) override
    {
        return to_payload(data, &payload);
    }
    bool deserialize(SerializedPayload_t& payload, void* data) override { return from_payload(&payload, data); }
    uint32_t calculate_serialized_size(const void* const data, DataRepresentationId_t) override
    {
        return static_cast<uint32_t>(static_cast<const Bytes*>(data)->size());
    }
    void* create_data() override { return new Bytes(); }
    void delete_data(void* data) override { delete static_cast<Bytes*>(data); }
    bool compute_key(SerializedPayload_t&, InstanceHandle_t&, bool) override { return false; }
    bool compute_key(const void* const, InstanceHandle_t&, bool) override { return false; }
#else
    bool serialize(void* data, SerializedPayload_t* payload) override { return to_payload(data, payload); }
    bool deserialize(SerializedPayload_t* payload, void* data) override { return from_payload(payload, data); }
    std::function<uint32_t()> getSerializedSizeProvider(void* data) override
    {
        return [data] { return static_cast<uint32_t>(static_cast<Bytes*>(data)->size()); };
    }
    void* createData() override { return new Bytes(); }
    void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
#endif

private:
    static bool to_payload(const void* data, SerializedPayload_t* payload)
    {
        const auto& bytes = *static_cast<const Bytes*>(data);
        if (bytes.size() > payload->max_size) {
            return false;
        }
        payload->encapsulation = CDR_LE;
        payload->length = static_cast<uint32_t>(bytes.size());
        std::memcpy(payload->data, bytes.data(), bytes.size());
        return true;
    }

    static bool from_payload(const SerializedPayload_t* payload, void* data)
    {
        static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
        return true;
    }
};

#if FAST_DDS_3
constexpr auto OK = RETCODE_OK;
bool written(DataWriter* writer, Bytes* bytes) { return writer->write(bytes) == OK; }
#else
const auto OK = ReturnCode_t::RETCODE_OK;
bool written(DataWriter* writer, Bytes* bytes) { return writer->write(bytes); }
#endif

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
