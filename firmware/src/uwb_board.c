#include <math.h>
#include <string.h>

#include "uwb_board.h"

int uwb_board_send(uwb_board *board, uint8_t type, uint16_t flags, uint64_t time_us, const void *payload,
                   size_t payload_bytes, size_t reserve) {
    const uwb_header_t header = {
        .version = UWB_PROTOCOL_VERSION, .type = type, .flags = flags, .time_us = time_us};
    return uwb_queue_frame(&board->queue, &header, payload, payload_bytes, reserve);
}

/* Send HELLO: the answer to the host's frame `*request`, or unsolicited if that is NULL. */
static void send_hello(uwb_board *board, const uint32_t *request, uint64_t now_us) {
    const uwb_board_config *const config = &board->config;
    uwb_hello_t message;
    memset(&message, 0, sizeof message);
    message.board_id = config->board_id;
    message.model_id = config->model != NULL ? config->model->model_id : 0;
    message.boot_id = config->boot_id;
    message.request_sequence = request != NULL ? *request : 0;
    message.window = config->model != NULL ? config->model->samples : 0;
    message.max_payload = UWB_MAX_PAYLOAD_BYTES;
    message.firmware_major = config->firmware_version[0];
    message.firmware_minor = config->firmware_version[1];
    message.firmware_patch = config->firmware_version[2];
    message.mode = board->mode;
    memcpy(message.firmware_name, config->firmware_name, sizeof message.firmware_name);
    const uint16_t flags = request != NULL ? UWB_FLAG_ANSWER : 0;
    (void)uwb_board_send(board, UWB_TYPE_HELLO, flags, now_us, &message, sizeof message, 0);
}

/* Offset of the ranges of a pair, m: the pair's own, else the sum of its tag's and its anchor's, else the default. */
static float offset_of_m(const uwb_board *board, uint64_t tag_id, uint64_t anchor_id) {
    float anchor_m = 0.0f;
    float tag_m = 0.0f;
    int found = 0;
    for (uint16_t i = 0; i < board->offset_count; i++) {
        const uwb_offset_t *const entry = &board->offsets[i];
        const int tag = entry->tag_id == tag_id;
        const int anchor = entry->anchor_id == anchor_id;
        if (entry->scope == UWB_OFFSET_SCOPE_PAIR && tag && anchor) {
            return entry->offset;
        }
        if (entry->scope == UWB_OFFSET_SCOPE_ANCHOR && anchor) {
            anchor_m = entry->offset;
            found = 1;
        } else if (entry->scope == UWB_OFFSET_SCOPE_TAG && tag) {
            tag_m = entry->offset;
            found = 1;
        }
    }
    return found ? anchor_m + tag_m : board->default_offset_m;
}

/* Correct a measurement and send the result; returns whether the queue had space for it. */
static int send_correction(uwb_board *board, const uwb_range_cir_t *fields, const uwb_cir *cir, uint16_t flags,
                   uint64_t time_us) {
    const uwb_board_config *const config = &board->config;
    const uint32_t began_us = config->clock_us != NULL ? config->clock_us() : 0;
    uwb_corrected corrected;
    const float offset_m = offset_of_m(board, fields->tag_id, fields->anchor_id);
    (void)uwb_correct(config->model, fields->range, offset_m, cir, config->arena, config->arena_bytes, &corrected);

    uwb_range_corrected_t message;
    memset(&message, 0, sizeof message);
    message.tag_id = fields->tag_id;
    message.anchor_id = fields->anchor_id;
    message.device_time = fields->device_time;
    message.sequence = fields->sequence;
    message.model_id = config->model->model_id;
    message.range = corrected.range_m;
    message.range_raw = fields->range;
    message.correction = corrected.correction_m;
    message.variance = corrected.variance_m2;
    message.compute_us = config->clock_us != NULL ? config->clock_us() - began_us : 0;
    message.status = (uint8_t)corrected.status;
    return uwb_board_send(board, UWB_TYPE_RANGE_CORRECTED, flags, time_us, &message, sizeof message,
                          UWB_ANSWER_RESERVE_BYTES);
}

static const float MAX_OFFSET_M = 10.0f;

/* Return whether an offset is between -10 and 10 m; false for NaN. */
static int is_valid_offset(float offset_m) {
    return offset_m >= -MAX_OFFSET_M && offset_m <= MAX_OFFSET_M;
}

/* Process the payload of a SET_OFFSETS, the host's frame `request`, and answer; returns whether it is well formed. */
static int set_offsets(uwb_board *board, const uint8_t *payload, size_t payload_bytes, uint32_t request,
                       uint64_t now_us) {
    uwb_set_offsets_t fixed;
    if (payload_bytes < sizeof fixed) {
        return 0;
    }
    memcpy(&fixed, payload, sizeof fixed);
    if (!is_valid_offset(fixed.default_offset) || (payload_bytes - sizeof fixed) / sizeof(uwb_offset_t) < fixed.count) {
        return 0;
    }
    for (size_t i = 0; i < fixed.count; i++) {
        uwb_offset_t entry;
        memcpy(&entry, payload + sizeof fixed + i * sizeof entry, sizeof entry);
        if (!is_valid_offset(entry.offset) || entry.scope > UWB_OFFSET_SCOPE_PAIR) {
            return 0;
        }
    }
    const uwb_offsets_t reply = {
        .request_sequence = request,
        .slots = UWB_MAX_OFFSETS,
        .accepted = fixed.count <= UWB_MAX_OFFSETS,
    };
    if (reply.accepted) {
        board->default_offset_m = fixed.default_offset;
        board->offset_count = fixed.count;
        memcpy(board->offsets, payload + sizeof fixed, fixed.count * sizeof(uwb_offset_t));
    }
    (void)uwb_board_send(board, UWB_TYPE_OFFSETS, UWB_FLAG_ANSWER, now_us, &reply, sizeof reply, 0);
    return 1;
}

void uwb_board_start(uwb_board *board, const uwb_board_config *config, uint64_t now_us) {
    memset(board, 0, sizeof *board);
    board->config = *config;
    board->queue.bytes = config->queue;
    board->queue.capacity = config->queue_bytes;
    board->status_due_us = now_us + UWB_STATUS_INTERVAL_US;
    board->temperature = NAN;
    board->mode = config->model != NULL ? config->mode : UWB_MODE_HOST;
    send_hello(board, NULL, now_us);
}

/* Handle a frame from the host; returns whether it was for the board. */
static int handle_frame(uwb_board *board, const uwb_header_t *header, size_t payload_bytes, uint64_t now_us) {
    const uint8_t *const payload = board->host.body.bytes + UWB_HEADER_BYTES;
    switch (header->type) {
    case UWB_TYPE_GET_INFO:
        send_hello(board, &header->sequence, now_us);
        return 1;
    case UWB_TYPE_SET_MODE:
        if (payload_bytes < sizeof(uwb_set_mode_t) || payload[0] > UWB_MODE_DEVICE) {
            return 0;
        }
        if (board->config.model != NULL || payload[0] == UWB_MODE_HOST) {
            board->mode = payload[0];
        }
        send_hello(board, &header->sequence, now_us);
        return 1;
    case UWB_TYPE_SET_OFFSETS:
        return set_offsets(board, payload, payload_bytes, header->sequence, now_us);
    case UWB_TYPE_TIME_SYNC: {
        uwb_time_sync_reply_t reply;
        memset(&reply, 0, sizeof reply);
        reply.request_sequence = header->sequence;
        reply.received_us = now_us;
        /* Put it before all queued frames: a short round trip improves the clock estimate of the host. */
        const uwb_header_t first = {.version = UWB_PROTOCOL_VERSION,
                                    .type = UWB_TYPE_TIME_SYNC_REPLY,
                                    .flags = UWB_FLAG_ANSWER,
                                    .time_us = UWB_TIME_OF_SENDING};
        (void)uwb_queue_urgent(&board->queue, &first, &reply, sizeof reply);
        return 1;
    }
    case UWB_TYPE_RANGE_CIR: {
        uwb_range_cir_t fields;
        uwb_cir cir;
        if (board->config.model == NULL || !uwb_read_measurement(payload, payload_bytes, &fields, &cir)) {
            return 0;
        }
        if (!send_correction(board, &fields, &cir, UWB_FLAG_ANSWER, now_us)) {
            board->measurements_lost++;
        }
        return 1;
    }
    default:
        return board->config.handle_other_frame != NULL &&
               board->config.handle_other_frame(board->config.context, header, payload, payload_bytes, now_us);
    }
}

void uwb_board_receive(uwb_board *board, const uint8_t *bytes, size_t count, uint64_t now_us) {
    const uint32_t foreign = board->host.foreign_versions;
    for (size_t i = 0; i < count; i++) {
        uwb_header_t header;
        const int32_t payload = uwb_decoder_push(&board->host, bytes[i], &header);
        if (payload >= 0 && !handle_frame(board, &header, (size_t)payload, now_us)) {
            board->dropped++;
        }
    }
    if (board->host.foreign_versions != foreign) {
        /* This frame shows the board's version to a host of another version. */
        send_hello(board, NULL, now_us);
    }
}

int uwb_board_process_measurement(uwb_board *board, const uint8_t *payload, size_t payload_bytes, uint64_t time_us) {
    uwb_range_cir_t fields;
    uwb_cir cir;
    int sent = 1;
    if (!uwb_read_measurement(payload, payload_bytes, &fields, &cir)) {
        return 0;
    }
    board->measurements++;
    if (board->mode != UWB_MODE_DEVICE) {
        sent = uwb_board_send(board, UWB_TYPE_RANGE_CIR, 0, time_us, payload, payload_bytes, UWB_ANSWER_RESERVE_BYTES);
    }
    if (board->mode != UWB_MODE_HOST) {
        sent = send_correction(board, &fields, &cir, 0, time_us) && sent;
    }
    if (!sent) {
        board->measurements_lost++;
    }
    return 1;
}

void uwb_board_receive_from_radio(uwb_board *board, const uint8_t *bytes, size_t count, uint64_t now_us) {
    for (size_t i = 0; i < count; i++) {
        if (board->radio.encoded == 0) {
            board->radio_frame_start_us = now_us;
        }
        uwb_header_t header;
        const int32_t payload = uwb_decoder_push(&board->radio, bytes[i], &header);
        if (payload >= 0) {
            const uint8_t *const bytes_of_payload = board->radio.body.bytes + UWB_HEADER_BYTES;
            if (header.type != UWB_TYPE_RANGE_CIR ||
                !uwb_board_process_measurement(board, bytes_of_payload, (size_t)payload, board->radio_frame_start_us)) {
                board->radio_faults++;
            }
        }
    }
}

/* Number of segments that are not an intact frame of any version. */
static uint32_t corrupt_frames(const uwb_decoder *decoder) {
    return decoder->bad_cobs + decoder->bad_length + decoder->bad_crc + decoder->oversize;
}

/* STATUS has no counter for damaged frames from the radio: report them in a LOG frame. */
static void log_radio_faults(uwb_board *board, uint64_t now_us) {
    static const char text[] = "frames from the radio are damaged, or are no measurements";
    const uint32_t faults = board->radio_faults + corrupt_frames(&board->radio) + board->radio.foreign_versions;
    if (faults != board->radio_faults_logged) {
        uint8_t payload[sizeof(uwb_log_t) + sizeof text - 1] = {UWB_LOG_LEVEL_WARNING};
        memcpy(payload + sizeof(uwb_log_t), text, sizeof text - 1);
        board->radio_faults_logged = faults;
        (void)uwb_board_send(board, UWB_TYPE_LOG, 0, now_us, payload, sizeof payload, 0);
    }
}

void uwb_board_tick(uwb_board *board, uint64_t now_us) {
    if (now_us < board->status_due_us) {
        return;
    }
    board->status_due_us = now_us + UWB_STATUS_INTERVAL_US;
    uwb_status_t status;
    memset(&status, 0, sizeof status);
    status.frames_received = board->host.frames;
    status.frames_dropped = corrupt_frames(&board->host) + board->dropped;
    status.measurements = board->measurements;
    status.measurements_lost = board->measurements_lost;
    status.temperature = board->temperature;
    status.mode = board->mode;
    (void)uwb_board_send(board, UWB_TYPE_STATUS, 0, now_us, &status, sizeof status, 0);
    log_radio_faults(board, now_us);
}
