/* GigE Vision for the GenTL producer: GVCP's registers and heartbeat, GVSP's packets and requests for lost ones. */
#include "gige_vision.h"

enum { MOST_PACKETS = 65536, TRIES = 5, HEADER = 8 };

struct sockaddr_in camera;
int control = -1, stream = -1, is_there, controls, is_acquiring, n_buffers, n_ready;
uint64_t delivered;
Buffer buffers[MOST_BUFFERS], *ready[MOST_BUFFERS];
pthread_mutex_t buffers_lock = PTHREAD_MUTEX_INITIALIZER;
pthread_cond_t filled = PTHREAD_COND_INITIALIZER;
static pthread_mutex_t control_lock = PTHREAD_MUTEX_INITIALIZER;
static uint16_t request;
static unsigned char got[MOST_PACKETS];

/* --- GigE Vision: control ------------------------------------------------------------------------------------- */

static uint32_t word(const void *from) {
    uint32_t value;
    memcpy(&value, from, 4);
    return ntohl(value);
}

static void set_word(void *to, uint32_t value) {
    value = htonl(value);
    memcpy(to, &value, 4);
}

void wait_at_most(int at, int ms) {
    struct timeval time = {ms / 1000, 1000 * (ms % 1000)};
    setsockopt(at, SOL_SOCKET, SO_RCVTIMEO, &time, sizeof time);
}

/* Send a command, and copy the data of its answer; returns their length, or an error. */
int ask(uint16_t command, const void *data, size_t length, char *answer, size_t room) {
    char message[600];
    int result = IO;
    if (control < 0) return IO;
    pthread_mutex_lock(&control_lock);
    request = request == 0xFFFF ? 1 : request + 1;
    set_word(message, 0x42010000u | command);
    set_word(message + 4, (uint32_t)length << 16 | request);
    memcpy(message + 8, data, length);
    for (int attempt = 0; attempt < 3 && result == IO; attempt++) {
        ssize_t count;
        char reply[600];
        sendto(control, message, 8 + length, 0, (struct sockaddr *)&camera, sizeof camera);
        while ((count = recv(control, reply, sizeof reply, 0)) >= 8) {
            if ((word(reply + 4) & 0xFFFF) != request) continue; /* a late answer */
            result = (int)count - 8;
            if (word(reply) >> 16) result = ACCESS_DENIED;
            else if ((size_t)result <= room) memcpy(answer, reply + 8, (size_t)result);
            break;
        }
    }
    pthread_mutex_unlock(&control_lock);
    return result;
}

GC_ERROR read_memory(uint64_t from, char *to, size_t length) {
    for (size_t done = 0; done < length;) {
        char question[8], answer[536];
        size_t part = length - done < 512 ? length - done : 512;
        set_word(question, (uint32_t)(from + done));
        set_word(question + 4, (uint32_t)((part + 3) & ~(size_t)3));
        int count = ask(0x84, question, 8, answer, sizeof answer);
        if (count < 0) return count;
        memcpy(to + done, answer + 4, part);
        done += part;
    }
    return GOOD;
}

GC_ERROR write_memory(uint64_t to, const char *from, size_t length) {
    char message[540], answer[16];
    if (length > 512) return INVALID_PARAMETER;
    set_word(message, (uint32_t)to);
    memcpy(message + 4, from, length);
    int count = ask(length == 4 ? 0x82 : 0x86, message, 4 + length, answer, sizeof answer);
    return count < 0 ? count : GOOD;
}

GC_ERROR write_word(uint32_t to, uint32_t value) {
    char data[4];
    set_word(data, value);
    return write_memory(to, data, 4);
}

void *beat(void *nothing) {
    char value[4];
    for (int tick = 1; controls; tick++) {
        if (tick % 10 == 0) read_memory(0xA00, value, 4);
        usleep(100000);
    }
    return nothing;
}

/* --- GigE Vision: stream --------------------------------------------------------------------------------------- */

static void ask_again(uint16_t block, uint32_t first, uint32_t last) {
    char message[20];
    set_word(message, 0x42000040);
    set_word(message + 4, 12u << 16 | 1);
    set_word(message + 8, block);
    set_word(message + 12, first);
    set_word(message + 16, last);
    sendto(stream, message, sizeof message, 0, (struct sockaddr *)&camera, sizeof camera);
}

static Buffer *next_queued(void) {
    for (int i = 0; i < n_buffers; i++)
        if (buffers[i].state == QUEUED) return &buffers[i];
    return NULL;
}

static void deliver(Buffer *buffer, int incomplete) {
    pthread_mutex_lock(&buffers_lock);
    buffer->state = FILLED;
    buffer->incomplete = incomplete;
    ready[n_ready++] = buffer;
    delivered++;
    pthread_cond_signal(&filled);
    pthread_mutex_unlock(&buffers_lock);
}

/* Ask for what is missing of packets 0…last; returns whether something is. */
static int ask_for_missing(uint16_t block, uint32_t last) {
    int missing = 0;
    for (uint32_t i = 0; i <= last; i++)
        if (!got[i]) missing = 1, ask_again(block, i, i);
    return missing;
}

void *receive(void *nothing) {
    static char packet[65536];
    char size[4];
    read_memory(0xD04, size, 4);
    size_t room = (word(size) & 0xFFFF) - 36;
    Buffer *buffer = NULL;
    uint16_t block = 0;
    uint32_t last = 0;
    int tries = 0, lost = 0;
    while (is_acquiring) {
        ssize_t count = recv(stream, packet, sizeof packet, 0);
        if (count >= HEADER) {
            uint32_t number = word(packet + 4) & 0xFFFFFF, kind = word(packet + 4) >> 24 & 0x7F;
            if (!buffer || (word(packet) & 0xFFFF) != block) {
                if (buffer) deliver(buffer, 1);
                pthread_mutex_lock(&buffers_lock);
                buffer = next_queued();
                pthread_mutex_unlock(&buffers_lock);
                if (!buffer) continue;
                block = word(packet) & 0xFFFF, last = 0, tries = 0, lost = 0;
                buffer->number = block, buffer->filled = 0;
                memset(got, 0, sizeof got);
            }
            if (number >= MOST_PACKETS || got[number]) continue;
            got[number] = 1;
            if (word(packet) >> 16 == 0x800C) lost = 1;
            else if (kind == 1) {
                buffer->timestamp = (uint64_t)word(packet + 12) << 32 | word(packet + 16);
                buffer->format = word(packet + 20), buffer->width = word(packet + 24), buffer->height = word(packet + 28);
            } else if (kind == 3 && (number - 1) * room + (size_t)count - HEADER <= buffer->size) {
                memcpy(buffer->base + (number - 1) * room, packet + HEADER, (size_t)count - HEADER);
                buffer->filled += (size_t)count - HEADER;
            } else if (kind == 2) last = number;
        }
        if (!buffer || (count > 0 && !last)) continue;
        int complete = last != 0;
        for (uint32_t i = 0; complete && i < last; i++) complete = got[i];
        if (complete || (count < 0 && tries == TRIES)) deliver(buffer, !complete || lost), buffer = NULL;
        else if (count < 0) tries++, ask_for_missing(block, last ? last : (uint32_t)((buffer->size + room - 1) / room + 1));
    }
    return nothing;
}
