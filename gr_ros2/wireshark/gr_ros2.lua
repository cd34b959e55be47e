-- Wireshark dissector for gr-ros2 packets, versions 0 and 1 of the wire format (docs/reference/wire-format.md).
--
-- Captures made by `gr-ros2 run --pcap` and `gr-ros2 link --pcap` (link type USER0) are recognised by themselves; for
-- packets carried in UDP use "Decode As". Install it with `gr-ros2 wireshark --install`, or try it with
-- `tshark -X lua_script:gr_ros2.lua -r FILE`.
--
-- Everything a receiver would refuse is an expert item of severity "error", named as the receiver's counter names it.
-- A packet of version 1 is checked from the first hello of its sender on. Tags are not checked and nothing is decrypted:
-- `gr-ros2 packet decode --key FILE` does both.

local xor = (bit or bit32).bxor
local proto = Proto("gr_ros2", "gr-ros2: ROS 2 topics over any radio")

local QOS = { [0] = "default", [1] = "latency", [2] = "bulk", [3] = "default (11)" }
local QOS_V1 = { [0] = "default", [1] = "latency", [2] = "bulk", [3] = "a repair packet" }
local KINDS = { [0] = "source", [1] = "repair", [2] = "control" }
local PLACES = { [0] = "whole message", [1] = "first fragment", [2] = "middle fragment", [3] = "last fragment" }
local CONTROLS = { [0xF6] = "left out", [0xF7] = "waited", [0xF8] = "hello", [0xF9] = "ask", [0xFA] = "report", [0xFB] = "heard", [0xFC] = "ping", [0xFD] = "about",
    [0xFE] = "newest" }
local BROADCAST, MOST_BLOCK = 255, 12
-- The byte before a packet that is bound to one radio, whose robot has starts, numbers and topics of its own there.
local BOUND, APART = 0x20, 256
local CRC_LEN, HEADER_LEN, ENTRY_HEADER_LEN = 2, 5, 5

local f = {
    bound = ProtoField.uint8("gr_ros2.bound", "Bound to one radio", base.HEX),
    version = ProtoField.uint8("gr_ros2.version", "Version", base.DEC, nil, 0x70),
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
    -- Version 1.
    kind = ProtoField.uint8("gr_ros2.kind", "Kind", base.DEC, KINDS),
    sealed = ProtoField.bool("gr_ros2.sealed", "Sealed (S)", 8, nil, 0x08),
    addressed = ProtoField.bool("gr_ros2.addressed", "Addressed (A)", 8, nil, 0x04),
    shares = ProtoField.bool("gr_ros2.shares", "A block for medium access follows (M)", 8, nil, 0x80),
    qos_bits = ProtoField.uint8("gr_ros2.qos_bits", "QoS", base.DEC, QOS_V1, 0x03),
    number = ProtoField.uint16("gr_ros2.number", "Number, low 16 bits"),
    packet_number = ProtoField.uint32("gr_ros2.packet_number", "Packet number"),
    hop_count = ProtoField.uint8("gr_ros2.hop_count", "Hop count"),
    slot = ProtoField.uint8("gr_ros2.slot", "Slot, mod 256"),
    slot_next = ProtoField.uint16("gr_ros2.slot.next", "Slots to the next send"),
    slot_after = ProtoField.uint16("gr_ros2.slot.after", "Slots from that to the one after"),
    slot_heard = ProtoField.uint8("gr_ros2.slot.heard", "Robots heard, by weight"),
    slot_name = ProtoField.uint8("gr_ros2.slot.name", "Hears robot", base.DEC, { [BROADCAST] = "none" }),
    slot_weight = ProtoField.uint8("gr_ros2.slot.weight", "Weight"),
    slot_map = ProtoField.uint32("gr_ros2.slot.map", "Expects to receive, bit i in slot + 1 + i", base.HEX),
    slot_conflict = ProtoField.uint8("gr_ros2.slot.conflict", "Slots to one that two robots want"),
    slot_yields = ProtoField.uint8("gr_ros2.slot.yields", "Gives it up", base.DEC, { [BROADCAST] = "none" }),
    window = ProtoField.uint8("gr_ros2.window", "Window", base.DEC, nil, 0x7F),
    masked = ProtoField.bool("gr_ros2.masked", "M: a mask follows, or not encrypted", 8, nil, 0x80),
    repair_id = ProtoField.uint8("gr_ros2.repair_id", "Repair id", base.DEC, nil, 0x7F),
    oldest = ProtoField.bool("gr_ros2.oldest", "Nothing older is repaired any more (O)", 8, nil, 0x80),
    mask = ProtoField.bytes("gr_ros2.mask", "Mask"),
    combined = ProtoField.bytes("gr_ros2.combined", "Combined bodies"),
    ciphertext = ProtoField.bytes("gr_ros2.ciphertext", "Encrypted body"),
    crc32 = ProtoField.uint32("gr_ros2.crc32", "CRC-32", base.HEX),
    tag = ProtoField.bytes("gr_ros2.tag", "Tag"),
    place = ProtoField.uint8("gr_ros2.place", "Place", base.DEC, PLACES, 0xC0),
    coded = ProtoField.bool("gr_ros2.coded", "Coded (C)", 8, nil, 0x20),
    fills = ProtoField.bool("gr_ros2.fills", "No length byte (F)", 8, nil, 0x10),
    back = ProtoField.uint32("gr_ros2.back", "Packets since the message began"),
    offset = ProtoField.uint32("gr_ros2.offset", "Offset in the message"),
    control = ProtoField.uint8("gr_ros2.control", "Control entry", base.HEX, CONTROLS),
    hello_boot = ProtoField.uint64("gr_ros2.hello.boot", "Boot number"),
    hello_turns = ProtoField.uint32("gr_ros2.hello.turns", "Turns of the packet number"),
    hello_hears = ProtoField.bool("gr_ros2.hello.hears", "Hears and reports", 8, nil, 0x01),
    hello_encrypts = ProtoField.bool("gr_ros2.hello.encrypts", "Encrypts", 8, nil, 0x02),
    hello_reported = ProtoField.bool("gr_ros2.hello.reported", "Gets reports", 8, nil, 0x04),
    hello_wants_proof = ProtoField.bool("gr_ros2.hello.wants_proof", "Wants proof", 8, nil, 0x08),
    hello_reads_left_out = ProtoField.bool("gr_ros2.hello.reads_left_out", "Reads left out", 8, nil, 0x10),
    hello_digest = ProtoField.uint32("gr_ros2.hello.digest", "digest of the table of topics", base.HEX),
    hello_topic_id = ProtoField.uint8("gr_ros2.hello.topic_id", "Kept for late joiners, topic id"),
    hello_mark = ProtoField.uint32("gr_ros2.hello.mark", "CRC-32 of that message", base.HEX),
    ask_src_id = ProtoField.uint8("gr_ros2.ask.src_id", "Asks robot"),
    ask_topic_id = ProtoField.uint8("gr_ros2.ask.topic_id", "For topic id"),
    report_src_id = ProtoField.uint8("gr_ros2.report.src_id", "Tells of the packets of robot"),
    report_boot = ProtoField.uint16("gr_ros2.report.boot", "Low 16 bits of its boot number"),
    report_number = ProtoField.uint16("gr_ros2.report.number", "Newest number of the map"),
    report_arrived = ProtoField.uint64("gr_ros2.report.arrived", "Map of what arrived", base.HEX),
    report_settled = ProtoField.bool("gr_ros2.report.settled", "Nothing older is wanted", 8, nil, 0x80),
    report_loss = ProtoField.uint8("gr_ros2.report.loss", "Packets lost lately, of 128", base.DEC, nil, 0x7F),
    report_snr = ProtoField.float("gr_ros2.report.snr", "SNR (dB)"),
    heard_src_id = ProtoField.uint8("gr_ros2.heard.src_id", "Has heard robot"),
    heard_echo = ProtoField.uint32("gr_ros2.heard.echo", "End of its newest hello", base.HEX),
    heard_since = ProtoField.uint16("gr_ros2.heard.since", "Heard at own number"),
    ping_robot = ProtoField.uint8("gr_ros2.ping.robot", "Robot"),
    ping_number = ProtoField.uint16("gr_ros2.ping.number", "Number of the question"),
    ping_reply = ProtoField.bool("gr_ros2.ping.reply", "Answer", 8, nil, 0x01),
    ping_count = ProtoField.uint16("gr_ros2.ping.count", "Questions that have come"),
    ping_held = ProtoField.uint16("gr_ros2.ping.held", "Held (0.1 ms)"),
    about_packet_len = ProtoField.uint16("gr_ros2.about.packet_len", "packet_len"),
    about_phy = ProtoField.uint32("gr_ros2.about.phy", "CRC-32 of the settings of the PHY", base.HEX),
    about_key = ProtoField.uint32("gr_ros2.about.key", "Fingerprint of the key", base.HEX),
    about_text = ProtoField.string("gr_ros2.about.text", "Text"),
    newest_origin = ProtoField.uint8("gr_ros2.newest.origin", "Robot whose topic it is"),
    newest_start = ProtoField.uint8("gr_ros2.newest.start", "Its boot number, low 8 bits", base.HEX),
    newest_topic_id = ProtoField.uint8("gr_ros2.newest.topic_id", "Topic id"),
    newest_number = ProtoField.uint32("gr_ros2.newest.number", "Its packet"),
    newest_place = ProtoField.uint8("gr_ros2.newest.place", "Place there, up to which all have come"),
    left_out_number = ProtoField.uint16("gr_ros2.left_out.number", "Newest number of the map"),
    left_out_packets = ProtoField.uint64("gr_ros2.left_out.packets", "Map of what nothing waits for", base.HEX),
    left_out_settled = ProtoField.bool("gr_ros2.left_out.settled", "Nothing older is repaired", 8, nil, 0x01),
    waited_age = ProtoField.uint8("gr_ros2.waited.age", "A message has waited, code"),
    relayed_taker = ProtoField.uint8("gr_ros2.relayed.taker", "Taken on by robot"),
    relayed_origin = ProtoField.uint8("gr_ros2.relayed.origin", "Robot that made the message"),
    relayed_start = ProtoField.uint16("gr_ros2.relayed.start", "Its boot number, low 16 bits", base.HEX),
    relayed_number = ProtoField.uint32("gr_ros2.relayed.number", "Its packet in which the message began"),
    relayed_place = ProtoField.uint8("gr_ros2.relayed.place", "Place there"),
    relayed_topic_id = ProtoField.uint8("gr_ros2.relayed.topic_id", "Topic id"),
    relayed_coded = ProtoField.bool("gr_ros2.relayed.coded", "Coded", 8, nil, 0x80),
    relayed_hops = ProtoField.uint8("gr_ros2.relayed.hops", "Hops", base.DEC, nil, 0x1F),
    relayed_age = ProtoField.uint8("gr_ros2.relayed.age", "Age when it was sent on, code"),
    relayed_limit = ProtoField.uint8("gr_ros2.relayed.limit", "Age at which it is of no more use, code"),
    relayed_waits = ProtoField.uint8("gr_ros2.relayed.waits", "Messages before it that its origin keeps"),
    relayed_back = ProtoField.uint32("gr_ros2.relayed.back", "Packets to the message before it"),
    relayed_after = ProtoField.uint8("gr_ros2.relayed.after", "Place of the message before it"),
    relayed_dst_id = ProtoField.uint8("gr_ros2.relayed.dst_id", "For robot"),
    table_topic_id = ProtoField.uint8("gr_ros2.table.topic_id", "Topic id"),
    table_name = ProtoField.string("gr_ros2.table.name", "Name"),
    table_type = ProtoField.string("gr_ros2.table.type", "Type"),
    table_codec = ProtoField.string("gr_ros2.table.codec", "Codec"),
    table_qos = ProtoField.uint8("gr_ros2.table.qos", "QoS class", base.DEC, QOS),
    table_reliable = ProtoField.bool("gr_ros2.table.reliable", "Reliable"),
    table_latched = ProtoField.bool("gr_ros2.table.latched", "Kept for late joiners"),
    table_depth = ProtoField.uint8("gr_ros2.table.depth", "Depth"),
    table_deadline = ProtoField.uint8("gr_ros2.table.deadline", "Deadline"),
}
local fields = {}
for _, field in pairs(f) do
    fields[#fields + 1] = field
end
proto.fields = fields

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
    window = refusal("window", "Window and mask contradict each other"),
    kind = refusal("entry_kind", "Flags or a fragment that cannot be"),
    varint = refusal("varint", "A number that is too long, too large, or longer than needed"),
}
local experts = {}
for _, expert in pairs(refused) do
    experts[#experts + 1] = expert
end
proto.experts = experts

proto.prefs.packet_len = Pref.uint(
    "Bytes of the longest packet", 0, "packet_len of the link; 0: as long as the longest packet so far (version 1)")
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

-- What was heard so far of the senders of version 1, filled as the packets are read for the first time.
local starts, frames, tables, announced, longest = {}, {}, {}, {}, {}

function proto.init()
    read_registry(proto.prefs.registry)
    starts, frames, tables, announced, longest = {}, {}, {}, {}, {}
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

local function dissect_v0(buffer, pinfo, tree)
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

-- Version 1 -----------------------------------------------------------------------------------------------------------

local TABLE_TOPIC, RELAYED_TOPIC, CARRIED_TOPIC, RELAYED_LEN = 240, 241, 242, 11
local MAX_MESSAGE, MAX_BACK = 0x1000000, 0x1FFFFF
local HELLO_LEN, MARK_LEN, REPORT_LEN, HEARD_LEN, PING_LEN, ABOUT_LEN, NEWEST_LEN = 17, 5, 14, 7, 17, 10, 5
local WHOLE_LEN = 8 -- a newest message of a reliable topic
local LEFT_OUT_LEN = 11
local MAX_SNR = 200 -- 60 dB

-- CRC-32 of IEEE 802.3.
local CRC32_TABLE = {}
for byte = 0, 255 do
    local crc = byte
    for _ = 1, 8 do
        local half = math.floor(crc / 2)
        crc = crc % 2 == 1 and xor(half, 0xEDB88320) % 0x100000000 or half
    end
    CRC32_TABLE[byte] = crc
end

local function crc32(crc, bytes)
    for place = 0, bytes:len() - 1 do
        local byte = bytes:get_index(place)
        crc = xor(math.floor(crc / 256), CRC32_TABLE[xor(crc % 256, byte)]) % 0x100000000
    end
    return crc
end

local function expected_crc32(boot, turns, buffer)
    local session = ByteArray.new(boot .. string.format("%08x", turns))
    return 0xFFFFFFFF - crc32(crc32(0xFFFFFFFF, session), buffer:bytes())
end

-- The full number nearest to the newest one that is known.
local function full_number(newest, low)
    local number = newest + (low - newest + 0x8000) % 0x10000 - 0x8000
    return number < 0 and low or number
end

local function name_of(src, id)
    local row = announced[src] and announced[src][id] or topics[id]
    return row and row.name or (id == TABLE_TOPIC and "table of topics" or id > TABLE_TOPIC and "relayed" or "topic " .. id), row
end

local function varint(buffer, at, limit)
    local value, scale = 0, 1
    for place = 1, 4 do
        if at >= limit then
            return nil, refused.overrun
        end
        local byte = buffer(at, 1):uint()
        at = at + 1
        value = value + byte % 128 * scale
        scale = scale * 128
        if byte < 128 then
            if byte == 0 and place > 1 then
                return nil, refused.varint
            end
            return value, at
        end
    end
    return nil, refused.varint
end

local function dissect_hello(buffer, tree, at, size)
    tree:add(f.hello_boot, buffer(at, 8))
    tree:add(f.hello_turns, buffer(at + 8, 4))
    tree:add(f.hello_hears, buffer(at + 12, 1))
    tree:add(f.hello_encrypts, buffer(at + 12, 1))
    tree:add(f.hello_reported, buffer(at + 12, 1))
    tree:add(f.hello_wants_proof, buffer(at + 12, 1))
    tree:add(f.hello_reads_left_out, buffer(at + 12, 1))
    tree:add(f.hello_digest, buffer(at + 13, 4))
    for mark = at + HELLO_LEN, at + size - 1, MARK_LEN do
        tree:add(f.hello_topic_id, buffer(mark, 1))
        tree:add(f.hello_mark, buffer(mark + 1, 4))
    end
end

local function dissect_control(buffer, tree, at, limit)
    if at + 2 > limit or at + 2 + buffer(at + 1, 1):uint() > limit then
        tree:add_proto_expert_info(refused.overrun)
        return nil
    end
    local kind, size = buffer(at, 1):uint(), buffer(at + 1, 1):uint()
    local item = tree:add(f.control, buffer(at, 1))
    local name = CONTROLS[kind] or string.format("unknown 0x%02x", kind)
    local start = at + 2
    local sizes = {
        hello = size >= HELLO_LEN and (size - HELLO_LEN) % MARK_LEN == 0,
        ask = size >= 2,
        report = size == REPORT_LEN or size == REPORT_LEN + 1,
        heard = size == HEARD_LEN,
        ping = size == PING_LEN,
        about = size >= ABOUT_LEN,
        newest = size == NEWEST_LEN or size == WHOLE_LEN,
        waited = size > 0,
        ["left out"] = size == LEFT_OUT_LEN,
    }
    if sizes[name] == false then
        item:add_proto_expert_info(refused.overrun)
        return nil
    elseif name == "hello" then
        dissect_hello(buffer, item, start, size)
    elseif name == "ask" then
        item:add(f.ask_src_id, buffer(start, 1))
        for topic = start + 1, start + size - 1 do
            item:add(f.ask_topic_id, buffer(topic, 1))
        end
    elseif name == "report" then
        item:add(f.report_src_id, buffer(start, 1))
        item:add(f.report_boot, buffer(start + 1, 2))
        item:add(f.report_number, buffer(start + 3, 2))
        item:add(f.report_arrived, buffer(start + 5, 8))
        item:add(f.report_settled, buffer(start + 13, 1))
        item:add(f.report_loss, buffer(start + 13, 1))
        if size > REPORT_LEN then
            if buffer(start + 14, 1):uint() > MAX_SNR then
                item:add_proto_expert_info(refused.kind)
                return nil
            end
            item:add(f.report_snr, buffer(start + 14, 1), buffer(start + 14, 1):uint() / 2 - 40)
        end
    elseif name == "heard" then
        item:add(f.heard_src_id, buffer(start, 1))
        item:add(f.heard_echo, buffer(start + 1, 4))
        item:add(f.heard_since, buffer(start + 5, 2))
    elseif name == "ping" then
        local snr = buffer(start + 16, 1):uint()
        item:add(f.ping_robot, buffer(start, 1))
        item:add(f.ping_number, buffer(start + 1, 2))
        item:add(f.ping_reply, buffer(start + 3, 1))
        item:add(f.ping_count, buffer(start + 4, 2))
        item:add(f.ping_held, buffer(start + 6, 2))
        if snr > MAX_SNR and snr < 255 then
            item:add_proto_expert_info(refused.kind)
            return nil
        elseif snr < 255 then
            item:add(f.report_snr, buffer(start + 16, 1), snr / 2 - 40)
        end
    elseif name == "about" then
        item:add(f.about_packet_len, buffer(start, 2))
        item:add(f.about_phy, buffer(start + 2, 4))
        item:add(f.about_key, buffer(start + 6, 4))
        if size > ABOUT_LEN then
            item:add(f.about_text, buffer(start + 10, size - ABOUT_LEN))
        end
    elseif name == "newest" then
        item:add(f.newest_origin, buffer(start, 1))
        item:add(f.newest_start, buffer(start + 1, 1))
        item:add(f.newest_topic_id, buffer(start + 2, 1))
        local whole = size == WHOLE_LEN
        item:add(f.newest_number, buffer(start + 3, whole and 4 or 2))
        if whole then
            item:add(f.newest_place, buffer(start + 7, 1))
        end
    elseif name == "left out" then
        item:add(f.left_out_number, buffer(start, 2))
        item:add(f.left_out_packets, buffer(start + 2, 8))
        item:add(f.left_out_settled, buffer(start + 10, 1))
    elseif name == "waited" then
        for age = start, start + size - 1 do
            item:add(f.waited_age, buffer(age, 1))
        end
    end
    return start + size, name
end

-- The rows of a table of topics; nil where it is none.
local function read_table(bytes)
    local rows, at = {}, 1
    if bytes:len() == 0 or bytes:get_index(0) ~= 1 then
        return nil
    end
    while at < bytes:len() do
        if at + 4 > bytes:len() then
            return nil
        end
        local flags = bytes:get_index(at + 1)
        local row = { id = bytes:get_index(at), flags = flags, depth = bytes:get_index(at + 2) }
        at = at + 3
        if math.floor(flags / 32) % 2 == 1 then
            at = at + 1 -- the robot for which it is
        end
        if math.floor(flags / 64) % 2 == 1 then
            if at >= bytes:len() then
                return nil
            end
            row.deadline, at = bytes:get_index(at), at + 1
        end
        for _, text in ipairs({ "name", "kind", "codec" }) do
            if at >= bytes:len() or at + 1 + bytes:get_index(at) > bytes:len() then
                return nil
            end
            local length = bytes:get_index(at)
            row[text] = length > 0 and bytes:subset(at + 1, length):raw() or ""
            at = at + 1 + length
        end
        rows[#rows + 1] = row
    end
    return rows
end

-- Keep a fragment of a row of a robot's table of topics; the row once all of it is here. What is sent again may be cut
-- elsewhere.
local function keep_fragment(src, begin, offset, last, bytes)
    tables[src] = tables[src] or {}
    local parts = tables[src][begin] or {}
    tables[src][begin] = parts
    parts[#parts + 1] = { from = offset, to = offset + bytes:len(), bytes = bytes }
    parts.total = last and offset + bytes:len() or parts.total
    table.sort(parts, function(one, other) return one.from < other.from end)
    local whole, at = ByteArray.new(), 0
    for _, part in ipairs(parts) do
        if part.from <= at and part.to > at then
            whole:append(part.bytes:subset(at - part.from, part.to - at))
            at = part.to
        end
    end
    if at ~= parts.total then
        return nil
    end
    tables[src][begin] = nil
    return read_table(whole)
end

-- The age for which a code stands, in words.
local function age_of(code)
    if code == 255 then
        return " (without limit)"
    end
    local steps = code < 16 and code or (16 + code % 16) * 2 ^ (math.floor(code / 16) - 1)
    return string.format(" (%g s)", steps / 100)
end

local function show_table(tree, range, rows)
    for _, row in ipairs(rows) do
        local item = tree:add(f.table_topic_id, range, row.id)
        item:append_text(row.name == "" and ": not offered any more" or string.format(": %s, %s", row.name, row.kind))
        item:add(f.table_name, range, row.name):set_generated()
        item:add(f.table_type, range, row.kind):set_generated()
        item:add(f.table_codec, range, row.codec):set_generated()
        item:add(f.table_qos, range, row.flags % 4):set_generated()
        item:add(f.table_reliable, range, math.floor(row.flags / 4) % 2 == 1):set_generated()
        item:add(f.table_latched, range, math.floor(row.flags / 8) % 2 == 1):set_generated()
        item:add(f.table_depth, range, row.depth):set_generated()
        if row.deadline then
            item:add(f.table_deadline, range, row.deadline):set_generated():append_text(age_of(row.deadline))
        end
    end
end

-- Whose message it is that stands in a message of another robot.
local function dissect_relayed(buffer, entry, id, at, after)
    if id == CARRIED_TOPIC and after > at + 2 then
        entry:add(f.relayed_taker, buffer(at, 1))
        entry:add(f.relayed_limit, buffer(at + 1, 1)):append_text(age_of(buffer(at + 1, 1):uint()))
        entry:add(f.relayed_waits, buffer(at + 2, 1))
        at = at + 3
    end
    if after < at + RELAYED_LEN then
        return
    end
    entry:add(f.relayed_origin, buffer(at, 1))
    entry:add(f.relayed_start, buffer(at + 1, 2))
    entry:add(f.relayed_number, buffer(at + 3, 4))
    entry:add(f.relayed_place, buffer(at + 7, 1))
    entry:add(f.relayed_topic_id, buffer(at + 8, 1))
    entry:add(f.relayed_coded, buffer(at + 9, 1))
    entry:add(f.relayed_hops, buffer(at + 9, 1))
    entry:add(f.relayed_age, buffer(at + 10, 1)):append_text(age_of(buffer(at + 10, 1):uint()))
    local flags = buffer(at + 9, 1):uint()
    at = at + RELAYED_LEN
    if math.floor(flags / 64) % 2 == 1 and after > at then
        entry:add(f.relayed_dst_id, buffer(at, 1))
        at = at + 1
    end
    if math.floor(flags / 32) % 2 == 1 then
        local back, place = varint(buffer, at, after)
        if back and place < after then
            entry:add(f.relayed_back, buffer(at, place - at), back)
            entry:add(f.relayed_after, buffer(place, 1))
        end
    end
end

-- One message or fragment; returns the place behind it, or nil where it cannot be one.
local function dissect_part(buffer, tree, packet, at, limit)
    local id = buffer(at, 1):uint() - 1
    local name, row = name_of(packet.src, id)
    local entry = tree:add(proto, buffer(at, limit - at), name)
    local function refuse(expert)
        entry:add_proto_expert_info(expert)
        return nil
    end
    entry:add(f.topic_id, buffer(at, 1), id)
    if row then
        entry:add(f.topic, buffer(at, 1), row.name):set_generated()
        entry:add(f.type_name, buffer(at, 1), row.kind):set_generated()
    end
    if at + 2 > limit then
        return refuse(refused.overrun)
    end
    local begin, flags = at, buffer(at + 1, 1):uint()
    local place, fills = math.floor(flags / 64), math.floor(flags / 16) % 2 == 1
    entry:add(f.place, buffer(at + 1, 1))
    entry:add(f.coded, buffer(at + 1, 1))
    entry:add(f.fills, buffer(at + 1, 1))
    at = at + 2
    local length, back, offset = nil, 0, 0
    if fills and flags % 16 ~= 0 then
        length = flags % 16
        entry:add(f.payload_len, buffer(at - 1, 1), length)
    elseif fills and packet.short then
        return refuse(refused.kind)
    elseif not fills then
        if at >= limit then
            return refuse(refused.overrun)
        end
        length = flags % 16 * 256 + buffer(at, 1):uint()
        entry:add(f.payload_len, buffer(at - 1, 2), length)
        at = at + 1
    end
    if place >= 2 then
        local next_at
        back, next_at = varint(buffer, at, limit)
        if not back then
            return refuse(next_at)
        end
        entry:add(f.back, buffer(at, next_at - at), back)
        at = next_at
        offset, next_at = varint(buffer, at, limit)
        if not offset then
            return refuse(next_at)
        end
        entry:add(f.offset, buffer(at, next_at - at), offset)
        at = next_at
        if offset == 0 and back == 0 then
            return refuse(refused.kind)
        end
    end
    local after = length and at + length or packet.filled
    if after > limit or after < at then
        return refuse(refused.overrun)
    elseif place > 0 and after == at then
        return refuse(refused.kind)
    elseif back > MAX_BACK or offset + after - at > MAX_MESSAGE then
        return refuse(refused.varint)
    end
    entry:set_len(after - begin)
    entry:append_text(string.format(", %s, %d bytes", PLACES[place], after - at))
    if after > at then
        entry:add(f.payload, buffer(at, after - at))
    end
    if id >= RELAYED_TOPIC and offset == 0 and back == 0 then
        dissect_relayed(buffer, entry, id, at, after)
    end
    if id == TABLE_TOPIC and packet.first_time and after > at then
        local rows = keep_fragment(
            packet.src, packet.number - back, offset, place % 3 == 0, buffer(at, after - at):bytes())
        packet.frame.rows = packet.frame.rows or {}
        packet.frame.rows[begin] = rows
        announced[packet.src] = announced[packet.src] or {}
        for _, row in ipairs(rows or {}) do
            announced[packet.src][row.id] = row.name ~= "" and row or nil
        end
    end
    if id == TABLE_TOPIC and packet.frame.rows and packet.frame.rows[begin] then
        show_table(entry, buffer(begin, after - begin), packet.frame.rows[begin])
    end
    return after, string.format("%s[%s]", name, PLACES[place]:match("^%w+"))
end

-- The entries of a body from `at` on, and the zeros behind them; what is to be said of them in a line.
local function dissect_body(buffer, tree, packet, at, limit)
    local summary, last = {}, math.min(limit, packet.filled)
    while at < last and buffer(at, 1):uint() ~= 0 do
        local control = buffer(at, 1):uint() > CARRIED_TOPIC + 1
        local after, text
        if control then
            after, text = dissect_control(buffer, tree, at, last)
        else
            after, text = dissect_part(buffer, tree, packet, at, last)
        end
        if not after then
            return summary
        end
        at, summary[#summary + 1] = after, text
    end
    dissect_pad(buffer, tree, at, limit)
    return summary
end

-- Window, repair id and mask; returns the place behind them and the window, or nil.
local function dissect_repair_header(buffer, tree, at, limit)
    if at + 2 > limit then
        tree:add_proto_expert_info(refused.overrun)
        return nil
    end
    local window, masked = buffer(at, 1):uint() % 128, buffer(at, 1):uint() > 127
    local item = tree:add(f.window, buffer(at, 1))
    tree:add(f.masked, buffer(at, 1))
    tree:add(f.repair_id, buffer(at + 1, 1))
    tree:add(f.oldest, buffer(at + 1, 1))
    at = at + 2
    if window > 0 and masked then
        local size = math.ceil(window / 8)
        if at + size > limit then
            item:add_proto_expert_info(refused.overrun)
            return nil
        end
        local mask, ones, top = tree:add(f.mask, buffer(at, size)), 0, -1
        for bit_number = 0, size * 8 - 1 do
            if math.floor(buffer(at + math.floor(bit_number / 8), 1):uint() / 2 ^ (bit_number % 8)) % 2 == 1 then
                ones, top = ones + 1, bit_number
            end
        end
        if buffer(at, 1):uint() % 2 == 0 or top ~= window - 1 or ones == window then
            mask:add_proto_expert_info(refused.window)
            return nil
        end
        at = at + size
    end
    return at, window, masked
end

-- Take the start of a robot that a hello tells of.
local function meet(buffer, packet, at)
    local boot, turns = buffer(at, 8):bytes():tohex(), buffer(at + 8, 4):uint()
    local number = turns * 0x10000 + packet.low
    local known = starts[packet.src] or {}
    starts[packet.src] = known
    for place, start in ipairs(known) do
        if start.boot == boot then
            table.remove(known, place)
            break
        end
    end
    known[#known + 1] = { boot = boot, newest = number, encrypts = buffer(at + 12, 1):bitfield(6, 1) == 1 }
end

-- Where the hello of a body begins, behind its name and size; nil where there is none. It is the first entry of a control
-- packet; in a packet of messages it may follow them.
local function find_hello(buffer, at, limit, messages)
    while at + 2 <= limit and buffer(at, 1):uint() > 0 do
        local name, second = buffer(at, 1):uint(), buffer(at + 1, 1):uint()
        if name > CARRIED_TOPIC + 1 then
            if CONTROLS[name] == "hello" and second >= HELLO_LEN and at + 2 + second <= limit then
                return at + 2
            end
            at = at + 2 + second
        else
            local long, kind = second % 32 < 16, math.floor(second / 64)
            if at + 3 > limit or (not long and second % 16 == 0) then
                return nil
            end
            local size = long and second % 16 * 256 + buffer(at + 2, 1):uint() or second % 16
            at = at + (long and 3 or 2)
            for _ = 1, kind >= 2 and 2 or 0 do
                while at < limit and buffer(at, 1):uint() > 127 do
                    at = at + 1
                end
                at = at + 1
            end
            at = at + size
        end
        if not messages then
            return nil
        end
    end
    return nil
end

-- Which start of its sender a packet belongs to, found when it is read for the first time: by its CRC, or the newest.
local function look_up(buffer, packet, limit)
    local known = starts[packet.src] or {}
    for place = #known, 1, -1 do
        local start = known[place]
        local number = full_number(start.newest, packet.low)
        local crc = not packet.sealed
            and expected_crc32(start.boot, math.floor(number / 0x10000), buffer(0, limit)) or nil
        if not packet.frame.number or crc == buffer(limit, 4):uint() then
            packet.frame.number, packet.frame.crc, packet.frame.encrypts = number, crc, start.encrypts
        end
        if packet.sealed or crc == buffer(limit, 4):uint() then
            start.newest = math.max(start.newest, number)
            return
        end
    end
end

-- The block for medium access; returns the place behind it, or nil.
local function dissect_block(buffer, tree, at, limit)
    local size = at + 6 <= limit and buffer(at + 3, 1):uint() > 127 and MOST_BLOCK or 6
    if at + size > limit then
        tree:add_proto_expert_info(refused.overrun)
        return nil
    end
    local function ahead(code)
        return code < 128 and code or 127 + 4 * (code - 127)
    end
    local heard = buffer(at + 3, 1):uint() % 128
    local block = tree:add(f.slot, buffer(at, 1))
    block:add(f.slot_next, buffer(at + 1, 1), ahead(buffer(at + 1, 1):uint()))
    block:add(f.slot_after, buffer(at + 2, 1), ahead(buffer(at + 2, 1):uint()))
    block:add(f.slot_heard, buffer(at + 3, 1), heard < 64 and heard or 63 + 3 * (heard - 63))
    block:add(f.slot_name, buffer(at + 4, 1))
    block:add(f.slot_name, buffer(at + 5, 1))
    if size == MOST_BLOCK then
        block:add(f.slot_weight, buffer(at + 6, 1), 1 + buffer(at + 6, 1):bitfield(0, 4))
        block:add(f.slot_map, buffer(at + 6, 4), buffer(at + 6, 4):bitfield(4, 28))
        block:add(f.slot_conflict, buffer(at + 10, 1))
        block:add(f.slot_yields, buffer(at + 11, 1))
    end
    return at + size
end

-- A packet of version 1; `apart` is what a robot's number is greater by among those whose starts and topics are known.
local function dissect_v1(buffer, pinfo, tree, apart)
    local first = buffer(0, 1):uint()
    local sealed, addressed = math.floor(first / 8) % 2 == 1, math.floor(first / 4) % 2 == 1
    local header, trailer = addressed and 6 or 4, sealed and 8 or 4
    if buffer:len() < header + trailer then
        tree:add_proto_expert_info(refused.length)
        return buffer:len()
    end
    local limit = buffer:len() - trailer
    tree:add(f.version, buffer(0, 1))
    tree:add(f.shares, buffer(0, 1))
    tree:add(f.sealed, buffer(0, 1))
    tree:add(f.addressed, buffer(0, 1))
    tree:add(f.qos_bits, buffer(0, 1))
    tree:add(f.src_id, buffer(1, 1))
    tree:add(f.number, buffer(2, 2))
    if addressed then
        tree:add(f.dst_id, buffer(4, 1))
        tree:add(f.hop_count, buffer(5, 1))
    end
    local frame = frames[pinfo.number]
    local first_time = not frame
    frame = frame or {}
    frames[pinfo.number] = frame
    longest[apart] = math.max(longest[apart] or 0, buffer:len())
    local packet = {
        src = buffer(1, 1):uint() + apart, low = buffer(2, 2):uint(), sealed = sealed, frame = frame, first_time = first_time,
    }
    local repair, shares = first % 4 == 3, first > 127
    local at, window, clear = header, nil, false
    if shares then
        at = dissect_block(buffer, tree, at, limit)
    end
    if repair and at then
        at, window, clear = dissect_repair_header(buffer, tree, at, limit)
        clear = window == 0 and clear
    end
    if first_time then
        local messages = not repair and not sealed
        local hello = at and (clear or messages) and find_hello(buffer, at, limit, messages)
        -- That of another start has no effect in a packet of messages.
        local own = hello and (clear or buffer(limit, 4):uint() == expected_crc32(
            buffer(hello, 8):bytes():tohex(), buffer(hello + 8, 4):uint(), buffer(0, limit)))
        if own then
            meet(buffer, packet, hello)
        end
        look_up(buffer, packet, limit)
    end
    packet.number = frame.number or packet.low
    tree:add(f.packet_number, buffer(2, 2), packet.number):set_generated()
    local kind = not repair and 0 or (window or 0) > 0 and 1 or 2
    tree:add(f.kind, buffer(0, 1), kind):set_generated()
    local intact = true
    if sealed then
        tree:add(f.tag, buffer(limit, trailer)):append_text(" (not checked: see gr-ros2 packet decode --key)")
    else
        local crc = tree:add(f.crc32, buffer(limit, trailer))
        if not frame.crc then
            crc:append_text(" (not checked: no hello of this robot before)")
        elseif frame.crc == buffer(limit, trailer):uint() then
            crc:append_text(" (correct)")
        else
            intact = false
            crc:append_text(string.format(" (should be 0x%08x)", frame.crc))
            crc:add_proto_expert_info(refused.crc)
        end
    end
    local summary = {}
    if not at then
        summary = { "refused" }
    elseif sealed and not clear and frame.encrypts ~= false then
        tree:add(f.ciphertext, buffer(at, limit - at))
        summary = { "encrypted" }
    elseif kind == 1 then
        tree:add(f.combined, buffer(at, limit - at))
        summary = { string.format("of %d..%d", packet.number - window + 1, packet.number) }
    elseif at < limit then
        local packet_len = math.max(proto.prefs.packet_len - (apart > 0 and 1 or 0), longest[apart])
        local room = packet_len - header - 2 - trailer - (shares and MOST_BLOCK or 0)
        -- Without the preference: where all packets are as long as this one, the longest body ends 2 bytes before the trailer; where a sender
        -- sends only what is needed, it ends with the longest packet's.
        if packet_len > proto.prefs.packet_len and packet_len == buffer:len() and buffer(limit - 2, 2):uint() ~= 0 then
            room = limit - at
        end
        packet.short, packet.filled = limit - at < room, at + room
        summary = dissect_body(buffer, tree, packet, at, limit)
    end
    pinfo.cols.src = "robot " .. buffer(1, 1):uint()
    pinfo.cols.dst = addressed and "robot " .. buffer(4, 1):uint() or "broadcast"
    pinfo.cols.info = string.format(
        "%s%s %d%s  %s", apart > 0 and "bound " or "", KINDS[kind], packet.number, intact and "" or " CRC mismatch", table.concat(summary, " "))
    return buffer:len()
end

function proto.dissector(buffer, pinfo, root)
    pinfo.cols.protocol = "gr-ros2"
    local tree = root:add(proto, buffer())
    if buffer:len() > 1 and buffer(0, 1):uint() == BOUND then
        tree:add(f.bound, buffer(0, 1))
        return 1 + dissect_v1(buffer(1):tvb(), pinfo, tree, APART)
    end
    if buffer:len() > 0 and buffer(0, 1):bitfield(1, 3) == 1 then
        return dissect_v1(buffer, pinfo, tree, 0)
    end
    return dissect_v0(buffer, pinfo, tree)
end

DissectorTable.get("wtap_encap"):add(wtap.USER0, proto)
DissectorTable.get("udp.port"):add_for_decode_as(proto)
