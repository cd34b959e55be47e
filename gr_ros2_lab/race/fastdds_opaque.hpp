// Opaque CDR messages for Fast DDS 2 and 3, as rmw_fastrtps has them: a type is no more than its name.

#pragma once

#include <cstring>
#include <functional>
#include <vector>

#include <fastdds/dds/publisher/DataWriter.hpp>
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
inline bool written(DataWriter* writer, Bytes* bytes) { return writer->write(bytes) == OK; }
#else
const auto OK = ReturnCode_t::RETCODE_OK;
inline bool written(DataWriter* writer, Bytes* bytes) { return writer->write(bytes); }
#endif
