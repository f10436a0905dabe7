/* Feeds arbitrary frames, registers and errors to a tag or an anchor, and stops on what breaks its promises: no access
 * outside of what the chip has, and no range but from frames of an exchange of its own.
 *
 *     clang -fsanitize=fuzzer,address,undefined -DUWB_LIBFUZZER -Isrc test/fuzz_radio.c src/uwb_*.c -lm
 *
 * Without a fuzzer it makes its own inputs: fuzz_radio <inputs> <seed>. */
#include "fuzz.h"
#include "uwb_mitigation.h"
#include "uwb_twr.h"

static unsigned long ranged, refused;

enum { OWN_ADDRESS = 0x77, PEER_ADDRESS = 0x99, PAST_FRAMES = 8, CANARY_FILE = 0x03 };
enum { CPLOCK = 2, TXFRS = 1 << 7, LDEDONE = 1 << 10, RXFCG = 1 << 14 };
static const uint32_t STATUS_BITS = 0x24B7FF00u;     /* bits that the driver acts on, and that stay until then */
static const uint32_t READ_ONLY = 0xC8100001u; /* go with the next_byte command */

/* A chip whose answers are taken from the input. */
typedef struct {
    const uint8_t *data;
    size_t left;
    uint64_t now_us;
    uint8_t canary[4];
    uwb_twr_frame sent;     /* last */
    uwb_twr_frame expected; /* the one frame that would go on with the exchange */
    int expecting;
    int steps; /* of the exchange, taken by frames that were right */
    uint8_t frame[127];
    size_t frame_bytes;
    uint32_t status;
    uwb_twr_frame past[PAST_FRAMES];
    unsigned past_count;
    uint8_t role;
    uint64_t antenna_delay, send_at, sent_at, received_at;
    uint64_t stamps[UWB_TWR_STAMPS]; /* of the exchange, at this chip */
} fake_chip;

static uint8_t next_byte(fake_chip *chip) {
    if (chip->left == 0) {
        return 0;
    }
    chip->left--;
    return *chip->data++;
}

static uint64_t from_little_endian(const uint8_t *octets, size_t bytes) {
    uint64_t value = 0;
    while (bytes != 0) {
        value = value << 8 | octets[--bytes];
    }
    return value;
}

static uint64_t device_time(const fake_chip *chip) {
    return chip->now_us * 63898u & UWB_DW1000_TICK_MASK;
}

/* The other side's stamps for a given time of flight, or impossible ones. */
static void set_expected_stamps(fake_chip *chip) {
    const uint64_t flight = next_byte(chip);
    const int tag = chip->role == UWB_ROLE_TAG;
    if (chip->expected.kind != UWB_TWR_REPORT) {
        chip->stamps[tag ? 1 : 2] = chip->received_at;
    }
    for (int i = 0; i < UWB_TWR_STAMPS; i++) {
        const uint64_t flight_offset = (i == 1) == tag ? (uint64_t)0 - flight : flight;
        chip->expected.stamps[i] = (chip->stamps[i] + flight_offset) & UWB_DW1000_TICK_MASK;
    }
    if (next_byte(chip) % 8 == 0) {
        chip->expected.stamps[next_byte(chip) % UWB_TWR_STAMPS] ^= (uint64_t)next_byte(chip) << 32;
    }
}

static void receive_frame(fake_chip *chip, const uwb_twr_frame *frame) {
    chip->frame_bytes = uwb_twr_write(frame, chip->frame);
    chip->status = LDEDONE | RXFCG;
}

/* A POLL of a tag, for an anchor. */
static uwb_twr_frame make_poll(fake_chip *chip) {
    uwb_twr_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.kind = UWB_TWR_POLL;
    frame.pan = uwb_twr_defaults.pan;
    frame.to = OWN_ADDRESS;
    frame.from = PEER_ADDRESS + (next_byte(chip) & 1u);
    frame.tag_number = (uint32_t)next_byte(chip) << 8 | next_byte(chip);
    frame.sequence = (uint8_t)frame.tag_number;
    frame.time_us = (uint32_t)next_byte(chip) << 8;
    return frame;
}

/* The single error of an otherwise correct frame. */
static void corrupt_frame(uwb_twr_frame *frame, uint8_t choice) {
    switch (choice % 7) {
    case 0:
        frame->pan ^= 1;
        break;
    case 1:
        frame->to ^= 2;
        break;
    case 2:
        frame->from ^= 4;
        break;
    case 3:
        frame->tag_number ^= (uint32_t)1 << 8;
        break;
    case 4:
        frame->anchor_number ^= (uint32_t)1 << 31;
        break;
    case 5:
        frame->sequence ^= 1;
        break;
    default:
        frame->kind = frame->kind == UWB_TWR_ANSWER ? UWB_TWR_REPORT : UWB_TWR_ANSWER;
        break;
    }
}

static void generate_event(fake_chip *chip) {
    const uint8_t choice = next_byte(chip);
    chip->status = 0;
    switch (choice % 8) {
    case 0: /* any bytes; the reported length may differ from their length */
        chip->frame_bytes = next_byte(chip) % 128u;
        for (size_t i = 0; i < chip->frame_bytes; i++) {
            chip->frame[i] = next_byte(chip);
        }
        chip->status = LDEDONE | RXFCG;
        break;
    case 1:
    case 2: /* the right one */
        if (chip->role == UWB_ROLE_ANCHOR && !chip->expecting) {
            const uwb_twr_frame poll = make_poll(chip);
            chip->received_at = chip->stamps[0] = device_time(chip);
            receive_frame(chip, &poll);
        } else if (chip->expecting) {
            chip->expecting = 0;
            chip->steps++;
            chip->received_at = device_time(chip);
            set_expected_stamps(chip);
            chip->past[chip->past_count++ % PAST_FRAMES] = chip->expected;
            receive_frame(chip, &chip->expected);
        }
        break;
    case 3: /* one that is nearly right; ANSWER's own from_little_endian is not known beforehand */
        if (chip->expecting) {
            uwb_twr_frame frame = chip->expected;
            corrupt_frame(&frame, frame.kind == UWB_TWR_ANSWER && choice / 8 % 7 == 4 ? 3 : choice / 8);
            receive_frame(chip, &frame);
        }
        break;
    case 4: /* an earlier frame */
        if (chip->past_count != 0) {
            const unsigned kept = chip->past_count < PAST_FRAMES ? chip->past_count : PAST_FRAMES;
            receive_frame(chip, &chip->past[next_byte(chip) % kept]);
        }
        break;
    case 5: /* errors and time-outs */
        chip->status = (uint32_t)1 << (next_byte(chip) % 32u);
        break;
    case 6:
        chip->status = (uint32_t)next_byte(chip) << 8 | (uint32_t)next_byte(chip) << 16 | (choice & 8u ? TXFRS : 0);
        chip->frame_bytes = 0;
        break;
    default:
        break;
    }
}

/* The frame that continues the exchange of the last frame sent. */
static void expect_answer(fake_chip *chip) {
    static const uwb_twr_frame_type answers[] = {0, 0, 0, UWB_TWR_ANSWER, UWB_TWR_FINAL, UWB_TWR_REPORT, 0};
    const uwb_twr_frame *const sent = &chip->sent;
    const uwb_twr_frame_type kind = answers[sent->kind];
    chip->expecting = kind != 0;
    if (!chip->expecting) {
        return;
    }
    if (kind == UWB_TWR_ANSWER || (kind == UWB_TWR_FINAL)) {
        chip->steps = 0;
    }
    chip->expected = *sent;
    chip->expected.kind = kind;
    chip->expected.to = sent->from;
    chip->expected.from = sent->to;
    if (kind == UWB_TWR_ANSWER) {
        chip->expected.anchor_number = (uint32_t)next_byte(chip) << 24 | next_byte(chip);
    }
}

static void write_register(fake_chip *chip, uint8_t file, size_t sub, const uint8_t *out, size_t bytes) {
    if (file == 0x03 && sub == 0 && bytes == 4) {
        memcpy(chip->canary, out, 4);
    }
    if (file == 0x09) {
        check(sub + bytes <= 125, "a frame fits the air");
        check(uwb_twr_read(out, bytes, &chip->sent), "what is sent is well formed");
        expect_answer(chip);
    }
    if (file == 0x18) {
        chip->antenna_delay = from_little_endian(out, bytes);
    }
    if (file == 0x0A) {
        chip->send_at = from_little_endian(out, bytes) & ~(uint64_t)0x1FF;
    }
    if (file == 0x0D && (out[0] & 2u)) {
        const uint64_t at = out[0] & 4u ? chip->send_at : device_time(chip);
        chip->sent_at = (at + chip->antenna_delay) & UWB_DW1000_TICK_MASK;
        const int tag_stamp = chip->sent.kind == UWB_TWR_FINAL ? 2 : 0;
        chip->stamps[chip->role == UWB_ROLE_ANCHOR ? 1 : tag_stamp] = chip->sent_at;
    }
    if (file == 0x0D && ((out[0] & 0x80u) || (bytes > 1 && (out[1] & 1u)))) {
        chip->status = 0; /* as when the receiver is enabled, immediately or after a frame */
    }
    if (file == 0x0F) {
        for (size_t i = 0; i < bytes && i < 4; i++) {
            chip->status &= ~((uint32_t)out[i] << 8 * i);
        }
        chip->status &= ~READ_ONLY;
    }
}

static void read_register(fake_chip *chip, uint8_t file, size_t sub, uint8_t *in, size_t bytes) {
    memset(in, 0, bytes);
    switch (file) {
    case 0x00: {
        static const uint8_t device[] = {0x30, 0x01, 0xCA, 0xDE};
        memcpy(in, device, bytes < 4 ? bytes : 4);
        break;
    }
    case CANARY_FILE:
        memcpy(in, chip->canary, bytes < 4 ? bytes : 4);
        break;
    case 0x0F:
        if ((chip->status & STATUS_BITS) == 0) {
            generate_event(chip);
        }
        chip->status |= CPLOCK | (next_byte(chip) & 3u ? TXFRS : 0);
        for (size_t i = 0; i < bytes && i < 4; i++) {
            in[i] = (uint8_t)(chip->status >> 8 * i);
        }
        break;
    case 0x10: {
        const size_t length = chip->frame_bytes + 2 + (next_byte(chip) == 255 ? next_byte(chip) * 4u : 0);
        in[0] = (uint8_t)length;
        in[1] = (uint8_t)(length >> 8 & 3u);
        in[2] = next_byte(chip);
        break;
    }
    case 0x11:
        check(bytes <= 125, "no frame is longer");
        memcpy(in, chip->frame, bytes < chip->frame_bytes ? bytes : chip->frame_bytes);
        break;
    case 0x15:
        for (size_t i = 0; i < bytes; i++) {
            in[i] = (uint8_t)(i < 5 ? chip->received_at >> 8 * i : next_byte(chip));
        }
        break;
    case 0x17:
        for (size_t i = 0; i < bytes && i < 5; i++) {
            in[i] = (uint8_t)(chip->sent_at >> 8 * i);
        }
        break;
    case 0x25:
        check(sub % 4 == 0 && bytes % 4 == 1 && sub + bytes - 1 <= 4064, "the window lies in the accumulator");
        break;
    default:
        for (size_t i = 0; i < bytes; i++) {
            in[i] = next_byte(chip);
        }
        break;
    }
}

static int transfer(void *context, const uint8_t *header, size_t header_bytes, const uint8_t *out, uint8_t *in,
                    size_t bytes) {
    fake_chip *const chip = context;
    size_t sub = header_bytes > 1 ? header[1] & 0x7Fu : 0;
    sub |= header_bytes > 2 ? (size_t)header[2] << 7 : 0;
    check(header_bytes >= 1 && header_bytes <= 3 && (out != NULL) == ((header[0] & 0x80) != 0), "a header says what it is");
    chip->now_us += 10;
    if (out != NULL) {
        write_register(chip, header[0] & 0x3Fu, sub, out, bytes);
    } else {
        read_register(chip, header[0] & 0x3Fu, sub, in, bytes);
    }
    return chip->left == 0 ? -1 : 0;
}

static void speed(void *context, int fast) {
    (void)context;
    (void)fast;
}

static uint64_t now_us(void *context) {
    return ++((fake_chip *)context)->now_us;
}

static void wait(void *context, uint64_t until_us) {
    fake_chip *const chip = context;
    chip->now_us += 50;
    (void)until_us;
}

static void sleep(void *context, uint32_t us) {
    ((fake_chip *)context)->now_us += us;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    fake_chip *const chip = calloc(1, sizeof *chip);
    uwb_twr *const twr = malloc(sizeof *twr);
    const size_t bytes = UWB_TWR_MEASUREMENT_BYTES(157);
    uint8_t *const measurement = malloc(bytes);
    check(chip != NULL && twr != NULL && measurement != NULL, "memory");
    chip->data = data;
    chip->left = size;
    const uint8_t choice = next_byte(chip);
    const uwb_dw1000_io io = {
        .context = chip, .transfer = transfer, .speed = speed, .now_us = now_us, .wait = wait, .sleep = sleep};
    uwb_twr_config config = uwb_twr_defaults;
    config.address = OWN_ADDRESS;
    config.role = choice & 1u ? UWB_ROLE_ANCHOR : UWB_ROLE_TAG;
    config.report = 1;
    config.anchor_count = choice & 2u ? 1 : 0;
    config.anchors[0] = PEER_ADDRESS;
    chip->role = config.role;
    uwb_twr_start(twr, &io, &config, choice, measurement, bytes);
    const int needed = config.role == UWB_ROLE_TAG ? 2 : 1;
    while (chip->left != 0) {
        const uwb_twr_event event = uwb_twr_step(twr, chip->now_us + 20000);
        if (event == UWB_TWR_RANGED) {
            uwb_range_cir_t fields;
            memcpy(&fields, measurement, sizeof fields);
            check(chip->steps == needed, "a range comes of an exchange of ours only");
            check(uwb_twr_measurement_bytes(twr) <= bytes, "a measurement fits its memory");
            check(fields.range > -11 && fields.range < 2001, "a range is one");
            chip->steps = 0;
            ranged++;
        }
        check(twr->known <= UWB_MAX_ANCHORS, "anchors fit their table");
        const uwb_twr_counts *const counts = &twr->counts;
        check(counts->tried == counts->ranged + counts->no_answer + counts->late + counts->timeout + counts->damaged +
                                   counts->implausible + counts->broken,
              "every exchange is counted once");
    }
    refused += twr->counts.refused;
    free(measurement);
    free(twr);
    free(chip);
    return 0;
}

#ifndef UWB_LIBFUZZER
int main(int argc, char **argv) {
    fuzz_run(argc, argv, 8000);
    printf("%lu ranges, %lu frames refused\n", ranged, refused);
    return 0;
}
#endif
