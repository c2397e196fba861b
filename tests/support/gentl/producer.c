/* A GenTL producer for one GigE Vision camera: what harvesters asks of one, and no more.
 *
 * Written from the GenTL standard 1.5 and the GigE Vision protocol; tests compile it, and nothing else uses it. The
 * environment variable GENTL_CAMERA has the camera's IP address. A process opens one camera, with one stream.
 */
#include "gige_vision.h"

enum { T_STRING = 1, T_INT32 = 5, T_UINT32 = 6, T_UINT64 = 8, T_PTR = 10, T_BOOL8 = 11, T_SIZET = 12 };

static char system_module, interface_module, device_module, remote_port, stream_module, new_buffer_event;
static char address_text[32], bootstrap[0xF8], url[512];
static pthread_t receiver, heart;

/* --- answers ------------------------------------------------------------------------------------------------- */

static GC_ERROR put(int32_t *type, void *out, size_t *size, int32_t kind, const void *value, size_t length) {
    if (type) *type = kind;
    if (out && *size < length) return TOO_SMALL;
    if (out) memcpy(out, value, length);
    *size = length;
    return GOOD;
}

static GC_ERROR put_text(int32_t *type, void *out, size_t *size, const char *text) {
    return put(type, out, size, T_STRING, text, strlen(text) + 1);
}

static GC_ERROR put_bool(int32_t *type, void *out, size_t *size, int value) {
    uint8_t byte = value != 0;
    return put(type, out, size, T_BOOL8, &byte, 1);
}

static GC_ERROR put_size(int32_t *type, void *out, size_t *size, size_t value) {
    return put(type, out, size, T_SIZET, &value, sizeof value);
}

static GC_ERROR put_u64(int32_t *type, void *out, size_t *size, uint64_t value) {
    return put(type, out, size, T_UINT64, &value, sizeof value);
}

/* --- GenTL: library, ports, events ------------------------------------------------------------------------------ */

GC_ERROR GCInitLib(void) { return GOOD; }
GC_ERROR GCCloseLib(void) { return GOOD; }
GC_ERROR GCGetLastError(GC_ERROR *code, char *text, size_t *size) {
    *code = GOOD;
    return put_text(NULL, text, size, "");
}

GC_ERROR TLGetInfo(Handle tl, int32_t what, int32_t *type, void *out, size_t *size) {
    (void)tl;
    uint32_t number = what == 9 ? 1 : what == 10 ? 5 : 0; /* version of the standard; ASCII */
    if (what >= 8) return put(type, out, size, what == 8 ? T_INT32 : T_UINT32, &number, 4);
    static const char *texts[] = {"tests", "orthocapture", "GigE Vision", "1", "GEV", "producer.cti", "producer.cti", "tests"};
    return what < 0 ? INVALID_PARAMETER : put_text(type, out, size, texts[what]);
}
GC_ERROR GCGetInfo(int32_t what, int32_t *type, void *out, size_t *size) { return TLGetInfo(NULL, what, type, out, size); }

GC_ERROR GCReadPort(Handle port, uint64_t address, void *out, size_t *size) {
    return port == &remote_port ? read_memory(address, out, *size) : NOT_AVAILABLE;
}
GC_ERROR GCWritePort(Handle port, uint64_t address, const void *data, size_t *size) {
    return port == &remote_port ? write_memory(address, data, *size) : NOT_AVAILABLE;
}
GC_ERROR GCGetPortInfo(Handle port, int32_t what, int32_t *type, void *out, size_t *size) {
    static const char *texts[] = {"port", "orthocapture", "GigE Vision", "GEV"};
    if (what >= 0 && what < 4) return put_text(type, out, size, texts[what]);
    if (what == 4)
        return put_text(type, out, size, port == &system_module ? "TLSystem" : port == &interface_module ? "TLInterface"
                        : port == &device_module ? "TLDevice" : port == &stream_module ? "TLDataStream" : "Device");
    if (what >= 5 && what <= 10) return put_bool(type, out, size, what == 6 || what == 7 || what == 8);
    return put_text(type, out, size, what == 12 ? "Device" : "1");
}
GC_ERROR GCGetNumPortURLs(Handle port, uint32_t *count) {
    *count = 1;
    return port == &remote_port ? read_memory(0x200, url, sizeof url) : NO_DATA;
}
GC_ERROR GCGetPortURLInfo(Handle port, uint32_t index, int32_t what, int32_t *type, void *out, size_t *size) {
    if (port != &remote_port || index) return INVALID_INDEX;
    return what == 0 ? put_text(type, out, size, url) : NOT_AVAILABLE;
}
GC_ERROR GCGetPortURL(Handle port, char *out, size_t *size) { return GCGetPortURLInfo(port, 0, 0, NULL, out, size); }

GC_ERROR GCRegisterEvent(Handle source, int32_t kind, Handle *event) {
    *event = &new_buffer_event;
    return source == &stream_module && kind == 1 ? GOOD : NOT_IMPLEMENTED;
}
GC_ERROR GCUnregisterEvent(Handle source, int32_t kind) { (void)source, (void)kind; return GOOD; }
GC_ERROR EventKill(Handle event) { (void)event; return GOOD; }
GC_ERROR EventFlush(Handle event) {
    (void)event;
    pthread_mutex_lock(&buffers_lock);
    n_ready = 0;
    pthread_mutex_unlock(&buffers_lock);
    return GOOD;
}
GC_ERROR EventGetInfo(Handle event, int32_t what, int32_t *type, void *out, size_t *size) {
    (void)event;
    int32_t kind = 1;
    if (what == 0) return put(type, out, size, T_INT32, &kind, 4);
    return what < 3 ? put_u64(type, out, size, (uint64_t)n_ready) : put_size(type, out, size, 2 * sizeof(void *));
}
GC_ERROR EventGetData(Handle event, void *out, size_t *size, uint64_t timeout_ms) {
    (void)event;
    struct timespec until;
    void *told[2];
    clock_gettime(CLOCK_REALTIME, &until);
    until.tv_sec += (time_t)(timeout_ms / 1000);
    until.tv_nsec += (long)(timeout_ms % 1000) * 1000000;
    if (until.tv_nsec >= 1000000000) until.tv_sec++, until.tv_nsec -= 1000000000;
    pthread_mutex_lock(&buffers_lock);
    while (!n_ready && pthread_cond_timedwait(&filled, &buffers_lock, &until) == 0) continue;
    int found = n_ready > 0;
    if (found) {
        told[0] = ready[0], told[1] = ready[0]->user;
        memmove(ready, ready + 1, (size_t)--n_ready * sizeof *ready);
    }
    pthread_mutex_unlock(&buffers_lock);
    return found ? put(NULL, out, size, 0, told, sizeof told) : TIMEOUT;
}
GC_ERROR EventGetDataInfo(Handle event, const void *data, size_t length, int32_t what, int32_t *type, void *out, size_t *size) {
    (void)event, (void)length;
    return what < 2 ? put(type, out, size, T_PTR, (const char *)data + what * sizeof(void *), sizeof(void *)) : NOT_AVAILABLE;
}

/* --- GenTL: system, interface, device ---------------------------------------------------------------------------- */

GC_ERROR TLOpen(Handle *tl) { *tl = &system_module; return GOOD; }
GC_ERROR TLClose(Handle tl) { (void)tl; return GOOD; }
GC_ERROR TLGetNumInterfaces(Handle tl, uint32_t *count) { (void)tl; *count = 1; return GOOD; }
GC_ERROR TLUpdateInterfaceList(Handle tl, uint8_t *changed, uint64_t timeout_ms) {
    (void)tl, (void)timeout_ms;
    if (changed) *changed = 0;
    return GOOD;
}
GC_ERROR TLGetInterfaceID(Handle tl, uint32_t index, char *out, size_t *size) {
    (void)tl;
    return index ? INVALID_INDEX : put_text(NULL, out, size, "network");
}
GC_ERROR IFGetInfo(Handle iface, int32_t what, int32_t *type, void *out, size_t *size) {
    (void)iface;
    return put_text(type, out, size, what == 2 ? "GEV" : "network");
}
GC_ERROR TLGetInterfaceInfo(Handle tl, const char *id, int32_t what, int32_t *type, void *out, size_t *size) {
    (void)id;
    return IFGetInfo(tl, what, type, out, size);
}
GC_ERROR TLOpenInterface(Handle tl, const char *id, Handle *iface) {
    (void)tl, (void)id;
    *iface = &interface_module;
    return GOOD;
}
GC_ERROR IFClose(Handle iface) { (void)iface; return GOOD; }
GC_ERROR IFGetParentTL(Handle iface, Handle *tl) { (void)iface; return TLOpen(tl); }

GC_ERROR IFUpdateDeviceList(Handle iface, uint8_t *changed, uint64_t timeout_ms) {
    const char *address = getenv("GENTL_CAMERA");
    (void)iface, (void)timeout_ms;
    if (!address || control >= 0) return GOOD;
    snprintf(address_text, sizeof address_text, "%s", address);
    camera.sin_family = AF_INET, camera.sin_port = htons(3956), camera.sin_addr.s_addr = inet_addr(address);
    control = socket(AF_INET, SOCK_DGRAM, 0);
    wait_at_most(control, 500);
    is_there = ask(0x02, "", 0, bootstrap, sizeof bootstrap) == (int)sizeof bootstrap;
    if (!is_there) close(control), control = -1;
    if (changed) *changed = (uint8_t)is_there;
    return GOOD;
}
GC_ERROR IFGetNumDevices(Handle iface, uint32_t *count) { (void)iface; *count = (uint32_t)is_there; return GOOD; }
GC_ERROR IFGetDeviceID(Handle iface, uint32_t index, char *out, size_t *size) {
    (void)iface;
    return index || !is_there ? INVALID_INDEX : put_text(NULL, out, size, address_text);
}
GC_ERROR DevGetInfo(Handle device, int32_t what, int32_t *type, void *out, size_t *size) {
    (void)device;
    int32_t status = controls ? 3 : 1; /* open by this process; free */
    switch (what) {
    case 0: case 4: return put_text(type, out, size, address_text);
    case 1: return put_text(type, out, size, bootstrap + 0x48);
    case 2: return put_text(type, out, size, bootstrap + 0x68);
    case 3: return put_text(type, out, size, "GEV");
    case 5: return put(type, out, size, T_INT32, &status, 4);
    case 6: return put_text(type, out, size, bootstrap + 0xE8);
    case 7: return put_text(type, out, size, bootstrap + 0xD8);
    case 8: return put_text(type, out, size, bootstrap + 0x88);
    default: return NOT_AVAILABLE;
    }
}
GC_ERROR IFGetDeviceInfo(Handle iface, const char *id, int32_t what, int32_t *type, void *out, size_t *size) {
    (void)id;
    return DevGetInfo(iface, what, type, out, size);
}
GC_ERROR IFOpenDevice(Handle iface, const char *id, int32_t access, Handle *device) {
    (void)iface, (void)access;
    if (strcmp(id, address_text) || !is_there) return INVALID_ID;
    if (write_word(0xA00, 2) < 0) return ACCESS_DENIED;
    controls = 1;
    pthread_create(&heart, NULL, beat, NULL);
    *device = &device_module;
    return GOOD;
}
GC_ERROR DevClose(Handle device) {
    (void)device;
    if (!controls) return GOOD;
    controls = 0;
    pthread_join(heart, NULL);
    write_word(0xA00, 0);
    close(control), control = -1, is_there = 0;
    return GOOD;
}
GC_ERROR DevGetPort(Handle device, Handle *port) { (void)device; *port = &remote_port; return GOOD; }
GC_ERROR DevGetParentIF(Handle device, Handle *iface) { (void)device; *iface = &interface_module; return GOOD; }
GC_ERROR DevGetNumDataStreams(Handle device, uint32_t *count) { (void)device; *count = 1; return GOOD; }
GC_ERROR DevGetDataStreamID(Handle device, uint32_t index, char *out, size_t *size) {
    (void)device;
    return index ? INVALID_INDEX : put_text(NULL, out, size, "stream");
}

/* --- GenTL: stream and buffers ------------------------------------------------------------------------------------- */

GC_ERROR DevOpenDataStream(Handle device, const char *id, Handle *ds) {
    struct sockaddr_in here = {.sin_family = AF_INET};
    socklen_t length = sizeof here;
    int wide = 4 << 20;
    (void)device, (void)id;
    stream = socket(AF_INET, SOCK_DGRAM, 0);
    setsockopt(stream, SOL_SOCKET, SO_RCVBUF, &wide, sizeof wide);
    wait_at_most(stream, 100);
    connect(control, (struct sockaddr *)&camera, sizeof camera); /* tells which of our addresses it sees */
    getsockname(control, (struct sockaddr *)&here, &length);
    uint32_t address = ntohl(here.sin_addr.s_addr);
    here.sin_port = 0;
    if (bind(stream, (struct sockaddr *)&here, sizeof here)) return IO;
    getsockname(stream, (struct sockaddr *)&here, &length);
    *ds = &stream_module;
    return write_word(0xD18, address) < 0 || write_word(0xD00, ntohs(here.sin_port)) < 0 ? IO : GOOD;
}
GC_ERROR DSClose(Handle ds) {
    (void)ds;
    if (stream >= 0) close(stream), stream = -1;
    return GOOD;
}
GC_ERROR DSGetParentDev(Handle ds, Handle *device) { (void)ds; *device = &device_module; return GOOD; }
GC_ERROR DSGetInfo(Handle ds, int32_t what, int32_t *type, void *out, size_t *size) {
    (void)ds;
    switch (what) {
    case 0: return put_text(type, out, size, "stream");
    case 1: return put_u64(type, out, size, delivered);
    case 2: return put_u64(type, out, size, 0);
    case 8: return put_bool(type, out, size, is_acquiring);
    case 9: return put_bool(type, out, size, 0); /* the camera's PayloadSize says */
    case 10: return put_text(type, out, size, "GEV");
    case 12: return put_size(type, out, size, 1);
    default: return NOT_AVAILABLE;
    }
}
GC_ERROR DSAnnounceBuffer(Handle ds, void *base, size_t size, void *user, Handle *buffer) {
    (void)ds;
    if (n_buffers == MOST_BUFFERS) return INVALID_PARAMETER;
    buffers[n_buffers] = (Buffer){.base = base, .size = size, .user = user, .state = ANNOUNCED};
    *buffer = &buffers[n_buffers++];
    return GOOD;
}
GC_ERROR DSRevokeBuffer(Handle ds, Handle buffer, void **base, void **user) {
    (void)ds;
    if (base) *base = ((Buffer *)buffer)->base;
    if (user) *user = ((Buffer *)buffer)->user;
    if (n_buffers && buffer == &buffers[n_buffers - 1]) n_buffers--;
    else if (!is_acquiring) ((Buffer *)buffer)->size = 0;
    for (; n_buffers && !buffers[n_buffers - 1].size; n_buffers--) continue;
    return GOOD;
}
GC_ERROR DSQueueBuffer(Handle ds, Handle buffer) { (void)ds; ((Buffer *)buffer)->state = QUEUED; return GOOD; }
GC_ERROR DSFlushQueue(Handle ds, int32_t what) {
    (void)ds, (void)what;
    for (int i = 0; i < n_buffers; i++) buffers[i].state = ANNOUNCED;
    return EventFlush(NULL);
}
GC_ERROR DSStartAcquisition(Handle ds, int32_t flags, uint64_t count) {
    (void)ds, (void)flags, (void)count;
    is_acquiring = 1;
    return pthread_create(&receiver, NULL, receive, NULL) ? IO : GOOD;
}
GC_ERROR DSStopAcquisition(Handle ds, int32_t flags) {
    (void)ds, (void)flags;
    if (is_acquiring) is_acquiring = 0, pthread_join(receiver, NULL);
    return GOOD;
}
GC_ERROR DSGetBufferID(Handle ds, uint32_t index, Handle *buffer) {
    (void)ds;
    *buffer = &buffers[index % MOST_BUFFERS];
    return index < (uint32_t)n_buffers ? GOOD : INVALID_INDEX;
}
GC_ERROR DSGetBufferInfo(Handle ds, Handle which, int32_t what, int32_t *type, void *out, size_t *size) {
    Buffer *buffer = which;
    (void)ds;
    switch (what) {
    case 0: return put(type, out, size, T_PTR, &buffer->base, sizeof buffer->base);
    case 1: return put_size(type, out, size, buffer->size);
    case 2: return put(type, out, size, T_PTR, &buffer->user, sizeof buffer->user);
    case 3: case 28: return put_u64(type, out, size, buffer->timestamp);
    case 4: return put_bool(type, out, size, buffer->state == FILLED);
    case 5: return put_bool(type, out, size, buffer->state == QUEUED);
    case 6: case 30: return put_bool(type, out, size, 0);
    case 7: return put_bool(type, out, size, buffer->incomplete);
    case 8: return put_text(type, out, size, "GEV");
    case 9: case 27: return put_size(type, out, size, buffer->filled);
    case 10: return put_size(type, out, size, buffer->width);
    case 11: case 22: return put_size(type, out, size, buffer->height);
    case 12: case 13: case 14: case 15: case 18: return put_size(type, out, size, 0);
    case 16: return put_u64(type, out, size, buffer->number);
    case 17: return put_bool(type, out, size, 1);
    case 19: return put_size(type, out, size, 1); /* an image */
    case 20: return put_u64(type, out, size, buffer->format);
    case 21: return put_u64(type, out, size, 4); /* PFNC, 32 bits */
    default: return NOT_AVAILABLE;
    }
}
