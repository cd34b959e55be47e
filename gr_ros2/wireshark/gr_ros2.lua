-- Wireshark dissector for gr-ros2 packets, version 0 of the wire format (docs/reference/wire-format.md).
--
-- Captures made by `gr-ros2 run --pcap` and `gr-ros2 link --pcap` (link type USER0) are recognised by themselves; for
-- packets carried in UDP use "Decode As". Install it with `gr-ros2 wireshark --install`, or try it with
-- `tshark -X lua_script:gr_ros2.lua -r FILE`.
--
-- Everything a receiver would refuse is an expert item of severity "error", named as the receiver's counter names it.

local xor = (bit or bit32).bxor
local proto = Proto("gr_ros2", "gr-ros2: ROS 2 topics in packets of fixed length")

local QOS = { [0] = "default", [1] = "latency", [2] = "bulk", [3] = "default (11)" }
local BROADCAST = 255
local CRC_LEN, HEADER_LEN, ENTRY_HEADER_LEN = 2, 5, 5

local f = {
    version = ProtoField.uint8("gr_ros2.version", "Version", base.DEC, nil, 0xF0),
    qos = ProtoField.uint8("gr_ros2.qos", "QoS", base.DEC, QOS, 0x0C),
    compressed = ProtoField.bool("gr_ros2.compressed", "Compressed (C)", 8, nil, 0x02),
    encrypted = ProtoField.bool("gr_ros2.encrypted", "Encrypted (E)", 8, nil, 0x01),
    src_id = ProtoField.uint8("gr_ros2.src_id", "Source id"),
    dst_id = ProtoField.uint8("gr_ros2.dst_id", "Destination id", base.DEC, { [BROADCAST] = "broadcast" }),
    seq = ProtoField.uint8("gr_ros2.seq", "Sequence number"),
    hop = ProtoField.uint8("gr_ros2.hop", "Hop count", base.DEC, nil, 0xF0),
    entries = ProtoField.uint8("gr_ros2.entries", "Entries", base.DEC, nil, 0x0F),
    topic_id = ProtoField.uint8("gr_ros2.topic_id", "Topic id"),
    topic = ProtoField.string("gr_ros2.topic", "Topic"),
    type_name = ProtoField.string("gr_ros2.type", "Type"),
    entry_id = ProtoField.uint8("gr_ros2.entry_id", "Entry id"),
    index = ProtoField.uint8("gr_ros2.index", "Index"),
    total = ProtoField.uint8("gr_ros2.total", "Total"),
    payload_len = ProtoField.uint16("gr_ros2.payload_len", "Payload length"),
    payload = ProtoField.bytes("gr_ros2.payload", "Payload"),
    pad = ProtoField.bytes("gr_ros2.pad", "PAD"),
    crc = ProtoField.uint16("gr_ros2.crc", "CRC-16", base.HEX),
}
proto.fields = {
    f.version, f.qos, f.compressed, f.encrypted, f.src_id, f.dst_id, f.seq, f.hop, f.entries, f.topic_id, f.topic,
    f.type_name, f.entry_id, f.index, f.total, f.payload_len, f.payload, f.pad, f.crc,
}

local function refusal(name, text)
    return ProtoExpert.new("gr_ros2.refused." .. name, text, expert.group.MALFORMED, expert.severity.ERROR)
end

local refused = {
    length = refusal("length", "The packet is too short to be one"),
    crc = refusal("crc", "CRC mismatch"),
    version = refusal("version", "Unknown version"),
    empty = refusal("no_entries", "E = 0"),
    overrun = refusal("entry_bounds", "An entry runs past the end of the packet"),
    pad = refusal("pad", "PAD is not zero"),
    total = refusal("total", "total = 0"),
    index = refusal("index", "index >= total"),
}
proto.experts = {
    refused.length, refused.crc, refused.version, refused.empty, refused.overrun, refused.pad, refused.total,
    refused.index,
}

proto.prefs.registry = Pref.string("Registry CSV", "", "The registry both ends use; shows topics by name")

-- Topics of the registry by id, read when the preference changes: rows `name,type`, as in docs/reference/wire-format.md.
local topics = {}

local function read_registry(path)
    topics = {}
    local file = path ~= "" and io.open(path)
    if not file then
        return
    end
    local id = 0
    for line in file:lines() do
        local name, kind = line:gsub("^\239\187\191", ""):gsub('"', ""):match("^%s*/?([%w_/]+)%s*,%s*([%w_/]+)")
        local heading = name and (name:lower() == "topic" or name:lower() == "name") and kind:lower() == "type"
        if name and not heading then
            topics[id] = { name = name, kind = kind }
            id = id + 1
        end
    end
    file:close()
end

function proto.prefs_changed()
    read_registry(proto.prefs.registry)
end

function proto.init()
    read_registry(proto.prefs.registry)
end

-- CRC-16, polynomial 0x1021, init 0, not reflected, no final xor.
local CRC_TABLE = {}
for byte = 0, 255 do
    local crc = byte * 256
    for _ = 1, 8 do
        crc = crc >= 0x8000 and xor((crc * 2) % 0x10000, 0x1021) or crc * 2
    end
    CRC_TABLE[byte] = crc
end

local function crc16(buffer)
    local crc, bytes = 0, buffer:bytes()
    for place = 0, bytes:len() - 1 do
        crc = xor((crc * 256) % 0x10000, CRC_TABLE[xor(math.floor(crc / 256), bytes:get_index(place))])
    end
    return crc
end

local function topic_name(id)
    return topics[id] and topics[id].name or ("topic " .. id)
end

-- One entry; returns the place behind it, or nil where it runs past `limit`.
local function dissect_entry(buffer, tree, number, topic_id, topic_at, at, limit)
    if at + ENTRY_HEADER_LEN > limit then
        tree:add_proto_expert_info(refused.overrun)
        return nil
    end
    local length = buffer(at + 3, 2):uint()
    local after = at + ENTRY_HEADER_LEN + length
    local index, total = buffer(at + 1, 1):uint(), buffer(at + 2, 1):uint()
    local shown = math.min(after, limit) - at
    local entry = tree:add(proto, buffer(at, shown), string.format(
        "Entry %d: %s, entry_id %d, fragment %d of %d, %d bytes",
        number, topic_name(topic_id), buffer(at, 1):uint(), index + 1, total, length))
    entry:add(f.topic_id, topic_at, topic_id)
    if topics[topic_id] then
        entry:add(f.topic, topic_at, topics[topic_id].name):set_generated()
        entry:add(f.type_name, topic_at, topics[topic_id].kind):set_generated()
    end
    entry:add(f.entry_id, buffer(at, 1))
    local index_item = entry:add(f.index, buffer(at + 1, 1))
    local total_item = entry:add(f.total, buffer(at + 2, 1))
    entry:add(f.payload_len, buffer(at + 3, 2))
    if total == 0 then
        total_item:add_proto_expert_info(refused.total)
    elseif index >= total then
        index_item:add_proto_expert_info(refused.index)
    end
    if after > limit then
        entry:add_proto_expert_info(refused.overrun)
        return nil
    end
    if length > 0 then
        entry:add(f.payload, buffer(at + ENTRY_HEADER_LEN, length))
    end
    return after, string.format("%s[%d/%d]", topic_name(topic_id), index + 1, total)
end

local function dissect_entries(buffer, tree, count, limit)
    local at = HEADER_LEN + math.ceil(count / 2)
    if at > limit then
        tree:add_proto_expert_info(refused.overrun)
        return nil, {}
    end
    local summary = {}
    for number = 0, count - 1 do
        local topic_at = buffer(HEADER_LEN + math.floor(number / 2), 1)
        local topic_id = topic_at:bitfield(number % 2 * 4, 4)
        local after, text = dissect_entry(buffer, tree, number, topic_id, topic_at, at, limit)
        if not after then
            return nil, summary
        end
        at, summary[#summary + 1] = after, text
    end
    return at, summary
end

local function dissect_pad(buffer, tree, at, limit)
    if at >= limit then
        return
    end
    local pad = buffer(at, limit - at)
    local item = tree:add(f.pad, pad)
    item:append_text(string.format(" (%d bytes)", limit - at))
    if not pad:bytes():tohex():match("^0*$") then
        item:add_proto_expert_info(refused.pad)
    end
end

function proto.dissector(buffer, pinfo, root)
    pinfo.cols.protocol = "gr-ros2"
    local tree = root:add(proto, buffer())
    if buffer:len() < HEADER_LEN + CRC_LEN then
        tree:add_proto_expert_info(refused.length)
        return buffer:len()
    end
    local limit = buffer:len() - CRC_LEN
    local version = tree:add(f.version, buffer(0, 1))
    tree:add(f.qos, buffer(0, 1))
    tree:add(f.compressed, buffer(0, 1))
    tree:add(f.encrypted, buffer(0, 1))
    tree:add(f.src_id, buffer(1, 1))
    tree:add(f.dst_id, buffer(2, 1))
    tree:add(f.seq, buffer(3, 1))
    tree:add(f.hop, buffer(4, 1))
    local entries = tree:add(f.entries, buffer(4, 1))
    local count = buffer(4, 1):bitfield(4, 4)
    local crc = tree:add(f.crc, buffer(limit, CRC_LEN))
    local expected = crc16(buffer(0, limit))
    local intact = buffer(limit, CRC_LEN):uint() == expected
    if intact then
        crc:append_text(" (correct)")
    else
        crc:append_text(string.format(" (should be 0x%04x)", expected))
        crc:add_proto_expert_info(refused.crc)
    end
    local summary = {}
    if buffer(0, 1):bitfield(0, 4) ~= 0 then
        version:add_proto_expert_info(refused.version)
    elseif count == 0 then
        entries:add_proto_expert_info(refused.empty)
    else
        local after
        after, summary = dissect_entries(buffer, tree, count, limit)
        if after then
            dissect_pad(buffer, tree, after, limit)
        end
    end
    local destination = buffer(2, 1):uint()
    pinfo.cols.src = "robot " .. buffer(1, 1):uint()
    pinfo.cols.dst = destination == BROADCAST and "broadcast" or "robot " .. destination
    pinfo.cols.info = string.format(
        "seq %d%s  %s", buffer(3, 1):uint(), intact and "" or " CRC mismatch", table.concat(summary, " "))
    return buffer:len()
end

DissectorTable.get("wtap_encap"):add(wtap.USER0, proto)
DissectorTable.get("udp.port"):add_for_decode_as(proto)
